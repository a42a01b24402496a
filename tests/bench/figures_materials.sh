#!/bin/sh
# tests/bench/figures_materials.sh [FIGURES] - the paper's figures 8 to 11 in shape, as CSV (and SVG where gnuplot is). Run from the repository root.
# FIGURES: a list with commas, or all (default):
#   size   RMSE against texture size (Fig. 8), and point lights against directional ones at each (Fig. 10)
#   seams  neighbours across seams or not (Fig. 9)
#   wreg   RMSE of fitted, unseen and all views against w_reg (Fig. 11), plain fit
# Environment: SET (D5)  SYNTH_OPTIONS (--size 360x240 --true-lights 1024 --samples 1)  SIZES (1 4 16 32 64 128 256)  W_REG (0 .001 .01 .1 1 10 100)
#   TEXTURE (256): of the albedo, and of seams and wreg  OUT (build/figures_materials)  BIN (build/bin)
set -eu
case ${1-} in -*) sed -n '2,8s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
figures=$(printf '%s' "${1:-all}" | tr , ' ')
[ "$figures" = all ] && figures="size seams wreg"
out=${OUT:-build/figures_materials} rigsolve=${BIN:-build/bin}/rigsolve set=${SET:-D5} texture=${TEXTURE:-256}
synth_options=${SYNTH_OPTIONS:---size 360x240 --true-lights 1024 --samples 1}
[ -x "$rigsolve" ] || { echo "figures_materials: no $rigsolve: run make" >&2; exit 2; }
mkdir -p "$out"
take=$out/$set
# shellcheck disable=SC2086 # options are words
[ -d "$take" ] || "$rigsolve" synth "$set" -o "$take" $synth_options
number() { # report, perl expression on $m: its "stages.materials"
    perl -MJSON::PP -0777 -ne '$m = decode_json($_)->{stages}{materials}; printf "%s", ('"$2"') // "-"' "$1"
}
solve() { # name, options: fit,held-out,seconds
    name=$1; shift
    "$rigsolve" solve "$take" -o "$out/$name" --lights-from "$lights" "$@" >/dev/null 2>&1
    r=$out/$name/report.json
    printf '%s,%s,%s' "$(number "$r" '$m->{rmse_fit_percent}')" "$(number "$r" '$m->{rmse_held_out_percent}')" "$(number "$r" '$m->{wall_s}')"
}
plot() { # csv, gnuplot's words
    command -v gnuplot >/dev/null || return 0
    gnuplot -e "set datafile separator ','; set key autotitle columnhead; set ylabel 'RMSE, %'; set term svg size 640,420; set output '${1%.csv}.svg'; $2"
}
lights=$take/truth/lights.json
directional=$out/directional.json # the same directions and irradiances, at infinity
perl -MJSON::PP -0777 -ne '$l = decode_json($_); for (ref $l eq "HASH" ? @{$l->{lights}} : @$l) { $_->{distance_m} = undef; $_->{pos_m} = undef }
    print JSON::PP->new->canonical->encode($l)' "$lights" >"$directional"

for figure in $figures; do
    csv=$out/$figure.csv
    case $figure in
    size)
        echo "parameter_texture,fit,held_out,seconds,directional_fit,directional_held_out,directional_seconds" >"$csv"
        for n in ${SIZES:-1 4 16 32 64 128 256}; do
            lights=$take/truth/lights.json; near=$(solve "size-$n" --texture "$texture" --parameter-texture "$n" --method alternating)
            lights=$directional; far=$(solve "size-$n-directional" --texture "$texture" --parameter-texture "$n" --method directional)
            echo "$n,$near,$far" | tee -a "$csv"
        done
        lights=$take/truth/lights.json
        plot "$csv" "set logscale x 2; set xlabel 'texture size'; plot '$csv' using 1:2 with lp, '' using 1:3 with lp, '' using 1:5 with lp, '' using 1:6 with lp" ;;
    seams)
        echo "seams,fit,held_out,seconds" >"$csv"
        echo "on,$(solve seams-on --texture "$texture" --method alternating)" | tee -a "$csv"
        echo "off,$(solve seams-off --texture "$texture" --method alternating --no-seams)" | tee -a "$csv" ;;
    wreg)
        echo "w_reg,fit,held_out,seconds" >"$csv"
        for w in ${W_REG:-0 .001 .01 .1 1 10 100}; do
            echo "$w,$(solve "wreg-$w" --texture "$texture" --method alternating --w-reg "$w")" | tee -a "$csv"
        done
        plot "$csv" "set logscale x; set xlabel 'w_reg'; plot '$csv' using (\$1>0?\$1:1e-4):2 with lp, '' using (\$1>0?\$1:1e-4):3 with lp" ;;
    *) echo "figures_materials: figure '$figure': expected size, seams, wreg" >&2; exit 2 ;;
    esac
done
