#!/bin/sh
# tests/demo.sh OUT - `make demo`: one button, end to end, explained line by line, and a page of pictures. A studio with a known answer is what
# rigsim's cameras see; rigd, libgphoto2, the developing and the solver are the real ones.
# BIN is where the programs lie, BOARDSIM the trigger board's simulation (is it not there, rigsim's wires are the trigger). OUT is replaced.
# RIG: how many cameras (12; 0: no rig, pictures go straight to the solver). RIG_SCENE: a folder with linear/, geometry/ (cameras of COLMAP as
# text), panorama.exr, start.json, and perhaps relit/ and truth/: what the cameras see instead of a synthetic studio (all views, or RIG of them).
# Its unseen.txt, if any, names the views to set aside. RIG_TEXTURE: texels across (128).
set -eu
out=${1:?usage: demo.sh OUT} bin=${BIN:-build/bin} scene=${RIG_SCENE:-}
boardsim=${BOARDSIM:-${bin%/bin}/tests/board/boardsim}
rigsolve=$bin/rigsolve
began=$(date +%s)
step() { printf '\n== [%3d s] %s\n' $(($(date +%s) - began)) "$*"; }
case $out in */demo) ;; *) echo "demo: refusing to replace $out: its name must end in /demo" >&2; exit 2 ;; esac
case ${RIG:-12} in *[!0-9]*) echo "demo: RIG=$RIG: expected how many cameras, 0 to 200" >&2; exit 2 ;; esac
if [ -n "$scene" ]; then
    for f in linear geometry/cameras/images.txt geometry/cameras/cameras.txt panorama.exr start.json; do
        [ -e "$scene/$f" ] || { echo "demo: RIG_SCENE=$scene has no $f" >&2; exit 2; }
    done
    scene=$(cd "$scene" && pwd)
    n_cameras=${RIG:-$(ls "$scene/linear" | grep -c '\.exr$')}
else
    n_cameras=${RIG:-12}
fi
rm -rf "$out"
mkdir -p "$out"
out=$(cd "$out" && pwd)

wires=$(mktemp -d) sim='' rigd='' # sockets have short names
stop() { # process
    [ -z "$1" ] || { kill "$1" 2>/dev/null && wait "$1" 2>/dev/null; } || true
}
finish() {
    status=$?
    stop "$rigd"
    stop "$sim"
    rm -rf "$wires"
    exit $status
}
trap finish EXIT
trap 'exit 130' INT TERM
fail() { echo "demo: $*" >&2; exit 1; }
rigctl() { "$bin/rigctl" "$@"; }
number() { # FILE KEY: the first number of that name in a JSON file
    tr -d ' \n' <"$1" | grep -o "\"$2\":-\{0,1\}[0-9][0-9.e+-]*" | head -n 1 | sed 's/.*://'
}

# ---- the studio ---------------------------------------------------------------------------------------------------------------
if [ -n "$scene" ]; then
    studio=$scene
    step "studio: $scene is what the cameras see"
elif [ "$n_cameras" -gt 0 ]; then
    studio=$out/studio
    step "studio: $n_cameras views of one Disney material in a room lit by thousands of small lights, with a known answer (data set D3)"
    # A panorama whose texels are as large as what the fisheye resolves: smaller ones could not be photographed in their place.
    size=720x480
    [ "$n_cameras" -le 24 ] || size=480x320
    "$rigsolve" synth D3 -o "$studio" --size $size --views "$n_cameras" --true-lights 4096 --panorama-width 512 --seed 1 --samples 1
else
    studio=$out/take
    step "studio: 85 views of one Disney material in a room lit by 16,384 small lights, with a known answer (data set D3)"
    "$rigsolve" synth D3 -o "$studio" --size 360x240 --true-lights 16384 --seed 1 --samples 2
fi

# ---- the rig ------------------------------------------------------------------------------------------------------------------
# Cameras get the views in order; fewer cameras than views: evenly spread.
place_cameras() {
    mkdir -p "$out/scene" "$out/fixed/cameras" "$out/takes" "$out/state"
    "$bin/rigsim" --cameras "$n_cameras" --list | sed -n 's/^\[camera "\(.*\)"\]/\1/p' >"$out/names"
    ls "$studio/linear" | sed -n 's/\.exr$//p' >"$out/views-there"
    n_views=$(wc -l <"$out/views-there")
    [ "$n_views" -ge "$n_cameras" ] || fail "$n_cameras cameras, but $studio/linear has $n_views views; RIG=$n_views"
    awk -v n="$n_cameras" -v of="$n_views" 'FNR == NR { name[NR - 1] = $0; next } { view[FNR - 1] = $0 }
        END { for (i = 0; i < n; i++) print view[int(i * of / n)], name[i] }' "$out/names" "$out/views-there" >"$out/cameras.txt"
    while read -r view name; do ln -s "$studio/linear/$view.exr" "$out/scene/$name.exr"; done <"$out/cameras.txt"
    rm "$out/names" "$out/views-there"
    cp "$studio"/geometry/mesh.* "$out/fixed/"
    cp "$studio/start.json" "$out/fixed/"
    cp "$studio"/geometry/cameras/*.txt "$out/fixed/cameras/"
    awk 'FNR == NR { name[$1] = $2; next }
        /^#/ { next }
        points { points = 0; if (keep) print ""; next }
        { view = $10; sub(/^.*\//, "", view); sub(/\.[^.]*$/, "", view); keep = view in name; points = 1; $10 = name[view] ".exr"; if (keep) print }' \
        "$out/cameras.txt" "$studio/geometry/cameras/images.txt" >"$out/fixed/cameras/images.txt"
    # Of other people's pictures sensors are twice as fine: a photosite has one colour, and real ones are finer than what is asked of them.
    finer=1
    [ -z "$scene" ] || finer=2
    size_px=$(awk -v k=$finer '!/^#/ && NF { print k * $3 "x" k * $4; exit }' "$studio/geometry/cameras/cameras.txt")
    if [ -n "$scene" ] && [ -f "$studio/unseen.txt" ]; then
        awk 'FNR == NR { name[$1 ".exr"] = $2; next } $1 in name { print name[$1] ".exr" }' "$out/cameras.txt" "$studio/unseen.txt" >"$out/unseen.txt"
    fi
}

write_config() { # simulated|usb
    cat <<E
[rig]
name = demo
takes = $out/takes
state = $out/state
socket = $wires/rigd
personality_dir = $PWD/config/cameras
raw_mb = 9
free_space_mb = 200
[settings]
imageformat = raw
iso = 100
aperture = 8
shutter = $shutter
[calibration]
within_ms = 0
[develop]
after = on
[reconstruct]
calibrated = $out/fixed
[solve]
preview = on
then = standard
options = $solve_options
E
    # The studio's panels are far brighter than white: a filter in front of the fisheye, as in a real studio.
    $simulate --list | awk -v kind="$1" -v nd=$nd_ev -v longest=$longest -v n=$((n_cameras + 1)) '
        BEGIN { registers = int((n + 7) / 8) }
        /^\[/ { section = $1 }
        section == "[trigger]" && kind == "usb" { if (/^\[/) print "[trigger]\nkind = usb\noutput_registers = " 3 * registers "\nhalf_press_ms = 500\nhold_ms = 150\nmax_hold_ms = 3000"; next }
        section == "[camera" && kind == "usb" && /^half_line/ { $3 += 8 * registers }
        section == "[camera" && kind == "usb" && /^relay_line/ { $3 += 16 * registers }
        section == "[panorama]" && /^head/ && kind == "usb" { $3 = "manual" }
        { print }
        /^\[panorama\]/ { print "neutral_density_ev = " nd "\nstops = 0,-20; 120,-20; 240,-20; 0,90\nmeter = 1/60\nlongest = " longest "\nsettle_ms = 200" }'
}

start_rigd() { # config, then the words before rigd
    config=$1
    shift
    "$@" "$bin/rigd" --config "$config" >>"$out/rigd.log" 2>&1 &
    rigd=$!
    tries=0
    until rigctl --json status 2>/dev/null | grep -q "\"n_ready\":$((n_cameras + 1)),"; do
        tries=$((tries + 1))
        [ $tries -lt 300 ] && kill -0 $rigd 2>/dev/null || return 1
        [ $((tries % 8)) -gt 0 ] || rigctl status 2>/dev/null | head -n 1 | sed 's/^/  /' # some two seconds
        sleep .2
    done
}
stop_rigd() { stop "$rigd"; rigd=''; }

within() { # tenths of a second, command...
    tries=$(($1)) && shift
    while [ $tries -gt 0 ]; do
        "$@" && return 0
        sleep .1
        tries=$((tries - 1))
        [ $((tries % 15)) -gt 0 ] || rigctl status 2>/dev/null | head -n 1 | sed 's/^/  /' # some two seconds
    done
    return 1
}
sees_board() { rigctl --json status 2>/dev/null | grep -q '"trigger":"usb"'; }
is_idle() { rigctl --json status 2>/dev/null | grep -q '"busy":false'; }
pressed() { # a take that was not there before has all its frames
    take=$(for t in "$out"/takes/*; do case "$before" in *"${t##*/}"*) ;; *) echo "$t" ;; esac; done | tail -n 1)
    [ -f "$take/take.json" ] && case $(state_of "$take") in
        verified | developed | solved) ;;
        failed) fail "the take failed: see $take/take.json" ;;
        *) false ;;
    esac
}
newest() { ls -d "$out"/takes/*_"$1" | tail -n 1; }
state_of() { grep -o '"state": *"[a-z]*"' "$1/take.json" | head -n 1 | cut -d'"' -f4; }

# As in any studio: test shots, a stop less each, until only glints and lamps in view are at white.
choose_shutter() {
    for shutter in 1/60 1/125 1/250 1/500 1/1000; do
        sed "s|^shutter = .*|shutter = $shutter|; s/^after = on/after = off/" "$out/rigd.conf" >"$out/rigd-test.conf"
        start_rigd "$out/rigd-test.conf" || fail "the cameras did not come up: see $out/rigd.log and $out/rigsim.log"
        rigctl capture --name test >/dev/null || fail "no test shot: see $out/rigd.log"
        stop_rigd
        "$bin/rigd-contact" "$(newest test)" -o "$out/test.png" >/dev/null
        headroom=$(number "$out/test.json" headroom_ev)
        printf 'a test shot at %s s: %.2f EV to white in four of five cameras, where the subject is\n' "$shutter" "$headroom"
        ! awk -v ev="$headroom" 'BEGIN { exit ev < .25 }' || break
    done
    sed -i "s|^shutter = .*|shutter = $shutter|" "$out/rigd.conf" "$out/rigd-board.conf"
}

use_rig() {
    place_cameras
    address=127.$((1 + ($$ >> 16 & 127))).$(($$ >> 8 & 255)).$(($$ & 255)) # nobody else's on this machine (tests/loopback.h)
    nd_ev=4 longest=1/4 panorama_gain=0.0625
    [ -z "$scene" ] || nd_ev=6 longest=1 panorama_gain=0.015625 # photographed studios have lamps hundreds of times as bright as white
    simulate="$bin/rigsim --cameras $((n_cameras + 1)) --personality nikon --address $address --seed 1 --raw-size $size_px --scene $out/scene --panorama $studio/panorama.exr --panorama-gain $panorama_gain --panorama-raw-size 1440x960 --trigger-socket $wires/wires"
    hold_out=every:6
    [ ! -s "$out/unseen.txt" ] || hold_out=list:$out/unseen.txt
    solve_options="--texture $texture --hold-out $hold_out"
    export RIGD_SOCKET="$wires/rigd"
    shutter=1/60
    write_config simulated >"$out/rigd.conf"
    write_config usb >"$out/rigd-board.conf"

    step "rig: $n_cameras simulated cameras and one with a fisheye, that real libgphoto2 talks to, and rigd with a process for each"
    $simulate >"$out/rigsim.log" 2>&1 &
    sim=$!
    while [ ! -S "$wires/wires" ]; do kill -0 "$sim" 2>/dev/null || fail "the cameras did not start: see $out/rigsim.log"; sleep .1; done
    [ -z "$scene" ] || choose_shutter
    start_rigd "$out/rigd.conf" || fail "the cameras did not come up: see $out/rigd.log and $out/rigsim.log"
    echo "$((n_cameras + 1)) of $((n_cameras + 1)) cameras are ready"

    step "panorama: a fisheye on a head sees the studio's lights in four stops; each is bracketed until no light clips, then merged"
    rigctl panorama --name lights || fail "no panorama: see $out/rigd.log"
    rigctl process "$(basename "$(newest lights)")" --watch || [ $? -eq 3 ] || fail "the panorama was not merged: see $(newest lights)/log"

    how='the button'
    if [ -x "$boardsim" ]; then
        step "board: the trigger board's real firmware runs in simavr; rigd starts anew and finds it on USB"
        stop_rigd
        if start_rigd "$out/rigd-board.conf" "$boardsim" --config "$out/rigd-board.conf" --wires "$wires/wires" && within 100 sees_board; then
            how='the button of the board'
        else
            echo "the board did not come up (see $out/rigd.log): on with rigsim's own wires"
            stop_rigd
            start_rigd "$out/rigd.conf" || fail "the cameras did not come up again: see $out/rigd.log"
        fi
    fi
    step "lag: each body's shutter lag is measured in five shots, and compensated from now on"
    rigctl calibrate lag --shots 5 >"$out/lag.txt" || fail "no lags: see $out/rigd.log"
    tail -n 4 "$out/lag.txt"

    step "$how: preflight, half-press, full-press, collect; every frame hashed, synced and read back"
    if [ "$how" = 'the button' ]; then
        rigctl capture --name demo || fail "no take: see $out/rigd.log"
        take=$(newest demo)
    else
        before=$(ls "$out/takes")
        within 100 is_idle || fail "the rig is not ready for the button: see $out/rigd.log"
        kill -USR1 "$rigd"
        within 1200 pressed || fail "the press became no take: see $out/rigd.log"
        rigctl takes
        # What a take is owed is in its ledger: the next rigd goes on, and the board's simulation takes no time from the solver.
        stop_rigd
        start_rigd "$out/rigd.conf" || fail "the cameras did not come up again: see $out/rigd.log"
    fi

    step "take: developed, lit by the panorama, the fixed rig's geometry; a preview, then the solve: one line per step"
    rigctl process "$(basename "$take")" --watch || [ $? -eq 3 ] || fail "not all was made: see $take/log"
    [ -f "$take/solve/standard/report.json" ] || fail "there is no solve: see $take/log/standard.log"
    solve=$take/solve/standard
    images=$take/linear
    cameras=$out/fixed/cameras
    panorama=$take/panorama.exr input=$take
    rigctl report "$(basename "$take")"
    stop_rigd
    stop "$sim"
    sim=''
}

# ---- a solve without a rig ------------------------------------------------------------------------------------------------------
no_rig() {
    step "solve: where the lights are, then textures of albedo and ten parameters, from the pictures and the panorama alone"
    solve=$out/solve
    images=$studio/linear
    cameras=$studio/geometry/cameras
    panorama=$studio/panorama.exr input=$studio
    "$rigsolve" solve "$studio" -o "$solve" --texture 256 || [ $? -eq 3 ] || fail "the solve failed"
}

texture=${RIG_TEXTURE:-128}
if [ "$n_cameras" -gt 0 ]; then use_rig; else no_rig; fi

# ---- how good is it -----------------------------------------------------------------------------------------------------------
step "judged: the solved material as the cameras see it that were set aside, beside their pictures; then under lights that the solve has never seen"
mkdir "$out/aside" # cameras of views that the solver did not fit
cp "$cameras"/*.txt "$out/aside/"
tr -d ' \n"' <"$solve/report.json" | sed -n 's/.*views_held_out:\[\([^]]*\)\].*/\1/p' | tr ',' '\n' | sed 's/\.exr$//' >"$out/views-all-aside"
awk '{ v[NR] = $0 } END { n = NR < 6 ? NR : 6; for (i = 0; i < n; i++) print v[int(i * NR / n) + 1] }' "$out/views-all-aside" >"$out/views-aside" # six are pictures enough
awk 'FNR == NR { is_aside[$1] = 1; next } /^#/ { next } points { points = 0; if (keep) print ""; next }
    { view = $10; sub(/\.[^.]*$/, "", view); keep = view in is_aside; points = 1; if (keep) print }' "$out/views-aside" "$cameras/images.txt" >"$out/aside/images.txt"
# To be compared is where the object is: pixels that get any light of a few lamps.
mask() { # cameras, panorama, JSON with its pose, folder to make, option
    # shellcheck disable=SC2086
    "$rigsolve" render "$solve" --cameras "$1" --panorama "$2" --world-from-probe "$3" -n 32 --no-shadows --samples 1 --exposure 20 -o "$4" $5 >/dev/null
    rm -f "$4"/*.exr
}
as_taken=
[ -z "${size_px-}" ] || as_taken="--size $size_px"
# shellcheck disable=SC2086
"$rigsolve" render "$solve" --cameras "$out/aside" -o "$out/views" --no-shadows $as_taken
mask "$out/aside" "$panorama" "$solve/report.json" "$out/masks" "$as_taken"
"$rigsolve" compare --mask "$out/masks" "$out/views" "$images" >"$out/compare.txt" 2>"$out/compare.log"
figure() { sed -n '$s/.*RMSE  *\([0-9.]* %\)  *PSNR  *\([0-9.]* dB\).*/\1 (\2)/p' "$1"; }
{
    printf 'views set aside, where texels are      RMSE %.3f %%   (fitted views %.3f %%)\n' "$(number "$solve/report.json" rmse_held_out_percent)" "$(number "$solve/report.json" rmse_fit_percent)"
    printf '%s of them, whole object with its edges RMSE %s\n' "$(wc -l <"$out/views-aside")" "$(figure "$out/compare.txt")"
} >"$out/figures.txt"
if [ -f "$studio/relit/probe.json" ] && [ -d "$studio/relit/linear" ]; then
    panels=$studio/relit/panels.json
    [ -f "$panels" ] || panels=$studio/relit/lights.json
    "$rigsolve" render "$solve" --cameras "$studio/relit/cameras" --panorama "$studio/relit/panorama.exr" --world-from-probe "$studio/relit/probe.json" --panels "$panels" -n 512 \
        -o "$out/relit" >/dev/null
    mask "$studio/relit/cameras" "$studio/relit/panorama.exr" "$studio/relit/probe.json" "$out/masks-relit" ''
    "$rigsolve" compare --mask "$out/masks-relit" "$out/relit" "$studio/relit/linear" >"$out/relit.txt"
    printf 'under other lights (512 of them)       RMSE %s\n' "$(figure "$out/relit.txt")" >>"$out/figures.txt"
fi
truth=
for f in report.json probe.json; do [ ! -f "$studio/truth/$f" ] || truth=$studio/truth/$f; done
centre() { tr -d ' \n' <"$1" | sed -n 's/.*"centre_m":\[\([^]]*\)\].*/\1/p'; }
[ -z "$truth" ] || echo "$(centre "$solve/report.json"),$(centre "$truth")" |
    awk -F, '{ printf "the place where the panorama was taken %.1f mm off\n", 1000 * sqrt(($1 - $4) ^ 2 + ($2 - $5) ^ 2 + ($3 - $6) ^ 2) }' >>"$out/figures.txt"
if [ -z "$scene" ]; then # one material: its parameters are known
    tr -d ' \n' <"$solve/report.json" | sed -n 's/.*"theta":\({[^}]*}\).*/\1/p' >"$out/theta.json"
    for p in metallic subsurface specular roughness specularTint sheen clearcoat; do
        printf '%-38s %6.3f   true %.3f\n' "$p" "$(number "$out/theta.json" $p)" "$(number "$studio/truth/material.json" $p)"
    done >>"$out/figures.txt"
fi
if grep -q '"trusted": *true' "$solve/report.json"; then echo "the solver trusts its result"; else echo "the solver does not trust its result, and says why: $solve/report.html"; fi >>"$out/figures.txt"
cat "$out/figures.txt"

# ---- the page -----------------------------------------------------------------------------------------------------------------
step "page: the lights by median cut, who sees which texel, what was solved"
"$rigsolve" lights "$panorama" -n 256 -o "$out/lights.json" --overlay "$out/lights.png"
"$rigsolve" visibility "$input" -o "$out" --texture 256 --lights 256 --overlay "$out/outlines" | tail -n 2
picture() { # file, caption, class
    [ -f "$1" ] && printf '<figure class="%s"><img alt="%s" src="data:image/png;base64,%s"><figcaption>%s</figcaption></figure>\n' \
        "${3:-}" "$2" "$(base64 -w0 "$1")" "$2"
}
escaped() { sed 's/&/\&amp;/g; s/</\&lt;/g' "$1"; }
{
    cat <<'HTML'
<!doctype html><html lang="en"><meta charset="utf-8"><title>studiorig: one button, end to end</title>
<style>body{font:16px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;background:#16181c;color:#ddd}
h1,h2{font-weight:600}figure{display:inline-block;margin:.4rem;vertical-align:top;width:calc(50% - 1rem)}figure.wide{width:100%}img{width:100%;border-radius:4px;display:block;background:#000}
figcaption{font-size:.85rem;color:#999;max-width:45rem}pre{background:#222;padding:1rem;overflow:auto;border-radius:4px}a{color:#8bf}</style>
<h1>One button, end to end</h1>
HTML
    printf '<p><a href="%s">The page of the solve</a> has its maps, lights and warnings.</p><pre>' "${solve#"$out"/}/report.html"
    escaped "$out/figures.txt"
    echo '</pre>'
    if [ -f "$input/sheet/thumbnails.png" ]; then
        echo '<h2>What the button brought</h2>'
        picture "$input/sheet/thumbnails.png" "The contact sheet: focus, clipping and darkness of each beside the others." wide
    fi
    echo '<h2>The lights</h2>'
    picture "$out/lights.png" "The panorama, cut into 256 regions of equal energy; a dot marks each light's direction." wide
    echo '<h2>What was solved, beside pictures that were set aside</h2>'
    for v in $(head -n 3 "$out/views-aside"); do
        picture "$out/outlines/$v.png" "$v: the picture, with the mesh's outline, traced"
        picture "$out/views/$v.png" "$v: the solved material under the solved lights"
    done
    if [ -d "$out/relit" ]; then
        echo '<h2>Under other lights</h2>'
        for f in $(ls "$out"/relit/*.png | head -n 2); do picture "$f" "the solved material in another studio"; done
    fi
    echo '<h2>Visibility, in the atlas</h2>'
    picture "$out/visibility/coverage.png" "Brighter: seen by more cameras."
    picture "$out/visibility/shadow.png" "Share of the light above a texel's horizon that reaches it."
    echo '<h2>Error of the re-render</h2><p>Of views that were not used for solving.</p><pre>'
    escaped "$out/compare.txt"
    echo '</pre></html>'
} >"$out/index.html.part"
mv "$out/index.html.part" "$out/index.html"
printf '\nSolved: %s\nThe page: %s (after %d s)\n' "$solve/report.html" "${1}/index.html" $(($(date +%s) - began))
