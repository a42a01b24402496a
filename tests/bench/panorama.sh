#!/bin/sh
# tests/bench/panorama.sh DIR PANORAMA... - the figures of issue 6: radiance, lights and variance after fisheye and rectilinear rigs; seconds
# and memory for 24 megapixels; where the solver finds the lights with the true and with the merged panorama. Leaves CSV and JSON in DIR.
set -eu
out=$1 bin=${BIN:-build/bin} bench=${BENCH:-build/tests/bench/bench_panorama}
shift
mkdir -p "$out"
[ -d "$out/synth" ] || "$bin/rigsolve" synth D3 -o "$out/synth" --size 180x120 --panorama-width 1024 --samples 1 --seed 1
echo "== radiance, beside hat weights and one exposure ($out/figures.csv)"
"$bench" figures "$@" | tee "$out/figures.csv"
echo "== variance"
"$bench" variance "$@"
echo "== 24 megapixels"
"$bench" frames "$out/frames"
for rig in fisheye rectilinear; do
    # All stops show the same frames, so stops that do not fit are announced: exit status 3.
    "$bin/rigd-panorama" "$out/frames/$rig.json" -o "$out/$rig.exr" 2>/dev/null || [ $? = 3 ]
    printf '%s: ' "$rig"
    tr -d '\n' <"$out/$rig-report.json" | grep -oE '"(wall_s|cpu_s|peak_rss_bytes|width_px)": [0-9.]*' | tr '\n' ' '
    echo
done
echo "== the solver with the true and with the merged panorama"
rm -rf "$out/take" "$out/merged" "$out/true" "$out/solve-true" "$out/solve-merged"
"$bench" take "$out/synth/panorama.exr" "$out/take"
cp -r "$out/synth" "$out/merged"
cp -r "$out/synth" "$out/true"
cp "$out/take/true.exr" "$out/true/panorama.exr"
"$bin/rigd-panorama" "$out/take/panorama.json" -o "$out/merged/panorama.exr" --size 1024
for which in true merged; do
    "$bin/rigsolve" solve "$out/$which" -o "$out/solve-$which" --preset preview --seed 1 >/dev/null || [ $? = 3 ]
    printf '%s: ' "$which"
    tr -d '\n' <"$out/solve-$which/report.json" | grep -oE '"(centre_m|world_from_probe)": [^"]*' | tr -s ' \n' ' '
    echo
done
