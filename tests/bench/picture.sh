#!/bin/sh
# tests/bench/picture.sh DEMO STUDIO VIEW RELIT OUT.png - the picture in README.md, of what `RIG_SCENE=STUDIO make demo` left in DEMO: a photograph that was set aside,
# the same view of what was solved, what was solved under other lights, and what it looks like there in truth. Wants a Chromium.
# BIN is where the programs lie.
#   sh tests/bench/picture.sh build/demo ../shared/data/studio-pebble A08 relit03 tests/results/demo.png
set -eu
demo=${1:?usage: picture.sh DEMO STUDIO VIEW RELIT OUT.png} studio=$2 view=$3 relit=$4 out=$5 bin=${BIN:-build/bin}
take=$(ls -d "$demo"/takes/*/solve/standard | tail -n 1) take=${take%/solve/standard}
solve=$take/solve/standard
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
one() { # cameras, view, folder to make: COLMAP's cameras with that view alone
    mkdir "$3"
    cp "$1"/cameras.txt "$1"/points3D.txt "$3"
    awk -v v="$2" '/^#/ { next } points { points = 0; if (keep) print ""; next } { points = 1; keep = $10 ~ "(^|/)" v "[.]"; if (keep) print }' "$1/images.txt" >"$3/images.txt"
}
one "$demo/aside" "$view" "$work/aside"
one "$studio/relit/cameras" "$relit" "$work/other"
panels=$studio/relit/lights.json
[ -f "$panels" ] || panels=$studio/relit/panels.json
mkdir -p "$work/photo/linear" "$work/true/linear"
cp "$take/linear/$view.exr" "$work/photo/linear/"
cp "$studio/relit/linear/$relit.exr" "$work/true/linear/"
for t in photo true; do "$bin/rigd-contact" --linear "$work/$t" -o "$work/sheet.png" --pictures "$work/$t" >/dev/null; done
"$bin/rigsolve" render "$solve" --cameras "$work/aside" -o "$work/again" >/dev/null
"$bin/rigsolve" render "$solve" --cameras "$work/other" --panorama "$studio/relit/panorama.exr" --world-from-probe "$studio/relit/probe.json" --panels "$panels" -n 4096 -o "$work/relit" >/dev/null
figure() { printf '<figure><img src="%s"><figcaption>%s</figcaption></figure>\n' "$1" "$2"; }
{
    echo '<!doctype html><meta charset="utf-8"><style>body{margin:0;background:#16181c;color:#bbb;font:14px sans-serif;width:1200px}figure{margin:4px;display:inline-block;width:291px;vertical-align:top}'
    echo 'img{width:100%;height:230px;object-fit:cover;border-radius:4px;display:block;background:#000}figcaption{padding:3px 2px}</style>'
    figure "photo/$view.png" 'photograph, not used for solving'
    figure "again/$view.png" 'solved materials and lights'
    figure "relit/$relit.png" 'solved materials, other lights'
    figure "true/$relit.png" 'the truth under those lights'
} >"$work/page.html"
chromium --headless=new --no-sandbox --disable-gpu --allow-file-access-from-files --window-size=1200,260 --screenshot="$work/out.png" "file://$work/page.html" >/dev/null 2>&1
cp "$work/out.png" "$out"
