#!/bin/sh
# tests/blender/check_blender.sh OUT - Debian's Blender opens what export wrote: it renders model.glb and the layers headless, under the
# solve's lights, and the RMSE against rigsolve render of the same solve is printed. OUT is replaced. BIN is where rigsolve lies;
# SET (D3) and STAGE (1) say what is solved.
# Needs blender and python3-numpy (apt-get install --no-install-recommends); not part of `make test`.
set -eu
out=${1:?usage: check_blender.sh OUT} rigsolve=${BIN:-build/bin}/rigsolve
command -v blender >/dev/null || { echo "check_blender: no blender here: apt-get install --no-install-recommends blender python3-numpy" >&2; exit 1; }
case $out in */blender) rm -rf "$out" ;; *) echo "check_blender: refusing to replace $out: its name must end in /blender" >&2; exit 2 ;; esac
mkdir -p "$out"
"$rigsolve" synth "${SET:-D3}" -o "$out/take" --size 180x120 --true-lights 1024 --samples 1
"$rigsolve" solve "$out/take" -o "$out/solve" --texture 128 --lights 64 --stage "${STAGE:-1}" >"$out/solve.txt" || [ $? = 3 ] # not trusted: as good here
"$rigsolve" export "$out/solve" -o "$out/export"
"$rigsolve" render "$out/solve" --cameras "$out/take/geometry/cameras" -o "$out/ours" --size 120x80
views="cam000 cam020 cam040"
for mode in glb layers; do
    blender -b --factory-startup --python-exit-code 1 --python tests/blender/render_views.py -- "$out/export" "$out/take/geometry/cameras" "$out/$mode" $mode \
        120x80 128 $views >"$out/$mode.txt" 2>&1 || { tail -n 20 "$out/$mode.txt" >&2; exit 1; }
    for v in $views; do
        printf '%s %s: ' "$mode" "$v"
        "$rigsolve" compare "$out/ours/$v.exr" "$out/$mode/$v.exr" | tail -n 1
    done
done
