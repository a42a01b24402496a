#!/bin/sh
# tests/demo.sh OUT - `make demo`: a synthetic studio end to end, explained line by line, and a page of pictures.
# BIN is where the programs lie. OUT is replaced. RIG: how many simulated cameras (12; 0: none).
set -eu
out=${1:?usage: demo.sh OUT} bin=${BIN:-build/bin} n_cameras=${RIG:-12}
rigsolve=$bin/rigsolve
step() { printf '\n== %s\n' "$*"; }
case $out in */demo) rm -rf "$out" ;; *) echo "demo: refusing to replace $out: its name must end in /demo" >&2; exit 2 ;; esac
mkdir -p "$out"

# ---- the button ---------------------------------------------------------------------------------------------------------------
wires=$(mktemp -d) sim='' rigd='' # sockets have short names
finish() {
    [ -z "$rigd" ] || { kill "$rigd" 2>/dev/null && wait "$rigd"; } || true
    [ -z "$sim" ] || { kill "$sim" 2>/dev/null && wait "$sim"; } || true
    rm -rf "$wires"
}
trap finish EXIT
if [ "$n_cameras" -gt 0 ]; then
    step "rig: $n_cameras simulated cameras that real libgphoto2 talks to, and rigd with a process for each"
    port=$((10000 + $$ % 1100 * 20))
    simulate="$bin/rigsim --cameras $n_cameras --personality nikon --port $port --seed 1 --trigger-socket $wires/wires"
    {
        printf '[rig]\nname = demo\ntakes = %s\nstate = %s\nsocket = %s\npersonality_dir = %s\nraw_mb = 9\nfree_space_mb = 200\n' \
            "$PWD/$out/takes" "$PWD/$out/state" "$wires/rigd" "$PWD/config/cameras"
        printf '[settings]\niso = 100\naperture = 8\nshutter = 1/60\n'
        $simulate --list
    } >"$out/rigd.conf"
    mkdir -p "$out/takes" "$out/state"
    $simulate >"$out/rigsim.log" 2>&1 &
    sim=$!
    while [ ! -S "$wires/wires" ]; do kill -0 "$sim" || exit 1; sleep .1; done
    "$bin/rigd" --config "$out/rigd.conf" >"$out/rigd.log" 2>&1 &
    rigd=$!
    export RIGD_SOCKET="$wires/rigd"
    tries=0
    until "$bin/rigctl" --json status 2>/dev/null | grep -q "\"n_ready\":$n_cameras,"; do
        tries=$((tries + 1))
        [ $tries -lt 150 ] || { echo "demo: the cameras did not come up: see $out/rigd.log and $out/rigsim.log" >&2; exit 1; }
        sleep .2
    done
    step "rig: each body's shutter lag is measured in five shots (some ten seconds), and compensated from now on"
    "$bin/rigctl" calibrate lag --shots 5 | tail -n 3
    step "rig: the button. Preflight, half-press, full-press, collect; every frame hashed, synced and read back"
    "$bin/rigctl" capture --name demo
    "$bin/rigctl" takes
    kill "$rigd" && wait "$rigd" || true
    kill "$sim" && wait "$sim" || true
    rigd='' sim=''
    echo "The frames, their ledger (take.json) and manifest: $out/takes/. Developing them is being built; the solve below goes on with a synthetic studio's pictures."
fi

step "1/5 a studio: data set D3 (one Disney material, off centre), 85 views, lit by 16,384 small lights on the walls of a room"
"$rigsolve" synth D3 -o "$out/take" --size 360x240 --true-lights 16384 --seed 1 --samples 2
step "2/5 the panorama becomes 256 lights by median cut"
"$rigsolve" lights "$out/take/panorama.exr" -n 256 -o "$out/lights.json" --overlay "$out/lights.png"
step "3/5 who sees which texel: 85 cameras and 256 lights, traced"
"$rigsolve" visibility "$out/take" -o "$out" --texture 256 --lights 256 --overlay "$out/outlines" |
    tail -n 2
step "4/5 solving: where the lights are, then textures of albedo and ten parameters, from the pictures and the panorama alone"
"$rigsolve" solve "$out/take" -o "$out/solve" --texture 256
step "5/5 what was solved, seen by the same cameras, beside the pictures (every 7th view was not used for solving)"
"$rigsolve" render "$out/solve" --cameras "$out/take/geometry/cameras" -o "$out/views" --no-shadows
"$rigsolve" compare "$out/views" "$out/take/linear" >"$out/compare.txt"
tail -n 1 "$out/compare.txt"

picture() { # file, caption, class
    [ -f "$1" ] && printf '<figure class="%s"><img alt="%s" src="data:image/png;base64,%s"><figcaption>%s</figcaption></figure>\n' \
        "${3:-}" "$2" "$(base64 -w0 "$1")" "$2"
}
{
    cat <<'HTML'
<!doctype html><html lang="en"><meta charset="utf-8"><title>studiorig: a synthetic studio</title>
<style>body{font:16px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;background:#16181c;color:#ddd}
h1,h2{font-weight:600}figure{display:inline-block;margin:.4rem;vertical-align:top;width:calc(50% - 1rem)}figure.wide{width:100%}img{width:100%;border-radius:4px;display:block;background:#000}
figcaption{font-size:.85rem;color:#999;max-width:45rem}pre{background:#222;padding:1rem;overflow:auto;border-radius:4px}</style>
<h1>A synthetic studio, end to end</h1>
<p>Data set D3: one Disney material with a coloured albedo, off the centre of a room whose walls carry four bright panels.</p>
<h2>The lights</h2>
HTML
    picture "$out/lights.png" "The panorama, cut into 256 regions of equal energy; a dot marks each light's direction." wide
    echo '<h2>What the cameras see</h2>'
    for v in 000 020 040 062; do picture "$out/outlines/cam$v.png" "cam$v with the mesh's outline, traced"; done
    echo '<h2>What was solved, re-rendered</h2>'
    for v in 000 020 040 062; do picture "$out/views/cam$v.png" "cam$v, re-rendered"; done
    echo '<h2>Visibility, in the atlas</h2>'
    picture "$out/visibility/coverage.png" "Brighter: seen by more cameras."
    picture "$out/visibility/shadow.png" "Share of the light above a texel's horizon that reaches it."
    picture "$out/visibility/cam000.png" "cam000: white visible, light grey grazing, dark grey occluded, black outside."
    echo '<h2>Error of the re-render</h2><p>Every 7th view (cam006, cam013, ...) was not used for solving.</p><pre>'
    sed 's/&/\&amp;/g; s/</\&lt;/g' "$out/compare.txt"
    echo '</pre></html>'
} >"$out/index.html.part"
mv "$out/index.html.part" "$out/index.html"
printf '\nThe page: %s\n' "$out/index.html"
