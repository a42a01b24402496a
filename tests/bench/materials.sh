#!/bin/sh
# tests/bench/materials.sh [SETS] - the materials of synthetic studios, end to end: made, solved with nothing given, rendered under lights that the solve has not
# seen, judged against the truth. Run from the repository root. SETS: a list with commas of D3, D4 (shadows, bounce) and D5 (four materials); all: default.
# Environment: SYNTH_OPTIONS (--size 360x240 --true-lights 16384 --samples 1)  SOLVE_OPTIONS (--texture 128)  SEED (1)  TAG (a name for these)
#   OUT (build/materials)  BIN (build/bin)  JUDGE (build/tests/bench/judge_materials)
set -eu
case ${1-} in -*) sed -n '2,5s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
sets=$(printf '%s' "${1:-D3,D4,D5}" | tr , ' ') seed=${SEED:-1} tag=${TAG-}
synth_options=${SYNTH_OPTIONS:---size 360x240 --true-lights 16384 --samples 1} solve_options=${SOLVE_OPTIONS:---texture 128}
out=${OUT:-build/materials} rigsolve=${BIN:-build/bin}/rigsolve judge=${JUDGE:-build/tests/bench/judge_materials}
refuse() { echo "materials: $*" >&2; exit 2; }
for d in $sets; do case $d in D[345]) ;; *) refuse "set '$d': expected D3, D4 or D5" ;; esac; done
for p in "$rigsolve" "$judge"; do [ -x "$p" ] || refuse "no $p: run make all build/tests/bench/judge_materials"; done
mkdir -p "$out"
for d in $sets; do
    take=$out/$d$tag-$seed solve=$out/$d$tag-$seed.solve code=0
    # shellcheck disable=SC2086 # options are words
    [ -d "$take" ] || "$rigsolve" synth "$d" -o "$take" --seed "$seed" $synth_options >/dev/null
    bounces=0 # as it was rendered
    [ "$d" = D4 ] && bounces=1
    # shellcheck disable=SC2086
    "$rigsolve" solve "$take" -o "$solve" --stage 2 --seed "$seed" --bounces $bounces $solve_options >"$take.log" || code=$?
    case $code in 0) verdict=trusted ;; 3) verdict='not to be trusted' ;; *) refuse "$d: the solve ended with $code: see $take.log" ;; esac
    rm -rf "$solve/relit"
    "$rigsolve" render "$solve" --cameras "$take/relit/cameras" --lights "$take/relit/lights.json" --samples 1 -o "$solve/relit" >/dev/null
    echo "$d, seed $seed: $verdict"
    grep -E '^(centre|materials|region)' "$take.log"
    "$judge" "$solve" "$take" "$solve/relit"
    perl -MJSON::PP -0777 -ne '$r = decode_json($_); printf "solve: %.0f CPU s, %.0f s by the clock, %.0f MB\n", $r->{cpu_s}, $r->{wall_s}, $r->{peak_rss_bytes} / 1e6' "$solve/report.json"
done
