#!/bin/sh
# tests/bench/scans.sh - scans by others, under photographed studios: made, solved, judged. Run from the repository root; needs the folder
# DATA (../shared/data) with mesh/ and hdri/ as its README says. What the solve says and what the judge finds, one after the other.
# Environment: OUT (build/scans)  BIN (build/bin)  JUDGE (build/tests/bench/judge_materials)  SIZE (360x240)  TEXTURE (256)  LIGHTS (16384)
#   METHODS (joint)  NOISE (0)
set -eu
case ${1-} in -*) sed -n '2,6s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
data=${DATA:-../shared/data} out=${OUT:-build/scans} rigsolve=${BIN:-build/bin}/rigsolve judge=${JUDGE:-build/tests/bench/judge_materials}
[ -d "$data/mesh" ] || { echo "scans: no $data/mesh: nothing to do" >&2; exit 0; }
[ -x "$rigsolve" ] && [ -x "$judge" ] || { echo "scans: no $rigsolve or $judge: run make all $judge" >&2; exit 2; }
mkdir -p "$out"
octabox=$data/hdri/studio_small_03_1k.hdr strips=$data/hdri/brown_photostudio_02_1k.hdr
head=$data/mesh/LeePerrySmith shoe=$data/mesh/MaterialsVariantsShoe
make_take() { # name, options
    take=$out/$1; shift
    [ -d "$take" ] || "$rigsolve" synth own -o "$take" "$@" --true-lights "${LIGHTS:-16384}" --size "${SIZE:-360x240}" --samples 1 --noise "${NOISE:-0}" --texture 1024
}
make_take head-octabox --mesh "$head/LeePerrySmith.glb" --flip-v --colour "$head/Map-COL.jpg" --theta roughness=.5,specular=.4 --light-from "$octabox" --relight-from "$strips"
make_take shoe-strips --mesh "$shoe/MaterialsVariantsShoe.gltf" --colour "$shoe/diffuseBeach.jpg" --material "$shoe/occlusionRougnessMetalness.jpg" --light-from "$strips" --relight-from "$octabox"
for name in head-octabox shoe-strips; do
    for method in ${METHODS:-joint}; do
        solve=$out/$name-$method
        "$rigsolve" solve "$out/$name" -o "$solve" --stage 2 --method "$method" --texture "${TEXTURE:-256}" >"$solve.log" 2>&1 || [ $? = 3 ]
        echo "== $name $method"
        "$rigsolve" render "$solve" --cameras "$out/$name/relit/cameras" --lights "$out/$name/relit/lights.json" --samples 1 -o "$solve/relit" >>"$solve.log" 2>&1
        tail -n 12 "$solve.log" | grep -E '^(stage|materials|region|lights|trusted|centre)' || true
        "$judge" "$solve" "$out/$name" "$solve/relit"
    done
done
