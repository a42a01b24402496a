#!/bin/sh
# tests/bench/studios.sh STUDIO... - what the whole chain loses of a studio whose answer is known, stage by stage. A studio is a folder that
# `make demo` takes as RIG_SCENE, with truth/ and relit/ (../shared/data/studio-pebble, a folder of `rigsolve synth own`). Each variant is
# solved with the same options, leaving out the same views, and judged against the truth; what is there already is not made again.
#   clean alternating directional   the studio's own pictures and panorama, straight to the solver; by the other methods
#   chain                           tests/demo.sh: button, cameras, bracketed panorama, developing, solve
#   chain-alternating chain-directional    the chain's pictures and panorama by the other methods
#   images                          the chain's pictures, the studio's panorama: what cameras and developing cost
#   panorama                        the studio's pictures, the chain's panorama: what photographing the lights costs
#   noiseless bilinear half coarse  raws of sensors without noise; other demosaicing; no more photosites than the studio has pixels;
#                                   each with the studio's panorama
# Environment: OUT (build/studios/out)  BIN (build/bin)  TOOLS (build/tests/bench)  VARIANTS (clean alternating directional chain images panorama)
#   TEXTURE (128)  TABLE=1: only what lies there
set -eu
case ${1-} in ''|-*) sed -n '2,14s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
bin=${BIN:-build/bin} tools=${TOOLS:-build/tests/bench} texture=${TEXTURE:-128}
variants=${VARIANTS:-clean alternating directional chain images panorama}
for p in "$bin/rigsolve" "$tools/judge" "$tools/judge_materials" "$tools/raws"; do [ -x "$p" ] || { echo "studios: no $p: run make bench-studios" >&2; exit 2; }; done
mkdir -p "${OUT:-build/studios/out}"
all=$(cd "${OUT:-build/studios/out}" && pwd)
csv=$all/studios.csv
say() { printf '%s %s\n' "$(date +%H:%M:%S)" "$*" >&2; }

hold_out() { # cameras as the chain calls them?
    if [ -f "$studio/unseen.txt" ]; then
        if [ "$1" = chain ]; then echo "list:$out/demo/unseen.txt"; else echo "list:$studio/unseen.txt"; fi
    else
        echo every:6
    fi
}
mesh() { ls "$1"/mesh.* | head -n 1; }

# solve NAME METHOD chain|clean IMAGES PANORAMA: into $out/NAME; geometry and names are those of the images.
solve() {
    geometry=$studio/geometry cameras=$studio/geometry/cameras
    [ "$3" = clean ] || geometry=$out/demo/fixed cameras=$out/demo/fixed/cameras
    say "$name $1: solve by $2"
    /usr/bin/time -f '%U %S' -o "$out/$1.time" "$bin/rigsolve" solve --mesh "$(mesh "$geometry")" --cameras "$cameras" --images "$4" --panorama "$5" \
        --world-from-probe "$studio/start.json" -o "$out/$1" --method "$2" --texture "$texture" --hold-out "$(hold_out "$3")" --seed 1 >"$out/$1.log" 2>&1 || [ $? = 3 ] ||
        { say "$name $1: failed: $(tail -n 1 "$out/$1.log")"; rm -rf "${out:?}/$1"; }
}

# raws NAME SIZE DEMOSAIC STATEMENT...: the studio's views through sensors, into $out/NAME-linear.
through_sensors() {
    to=$out/$1 size=$2 how=$3
    shift 3
    mkdir -p "$to-raw" "$to-linear"
    "$tools/raws" "$size" "$to-raw" "$studio/linear" "$@"
    "$bin/rigctl" develop "$to-raw"/*.dng -o "$to-linear" "$how" >/dev/null
    rm -r "$to-raw"
}

taken() { ls -d "$out"/demo/takes/*/solve/standard/report.json 2>/dev/null | sed 's,/solve/standard/report.json$,,' | tail -n 1; } # by command or by the board's button

chain() {
    [ -z "$(taken)" ] || return 0
    say "$name: the whole chain"
    RIG_SCENE=$studio RIG_TEXTURE=$texture BIN=$bin sh tests/demo.sh "$out/demo" >"$out/demo.log" 2>&1 || { say "$name: the chain failed: $(tail -n 1 "$out/demo.log")"; return 1; }
}

make_variant() {
    w=$(awk '!/^#/ && NF { print $3; exit }' "$studio/geometry/cameras/cameras.txt") h=$(awk '!/^#/ && NF { print $4; exit }' "$studio/geometry/cameras/cameras.txt")
    fine=$((2 * w))x$((2 * h)) true=$studio/panorama.exr
    case $1 in
    chain*|images|panorama) chain || return 0; take=$(taken) ;;
    esac
    case $1 in
    clean) solve clean joint clean "$studio/linear" "$true" ;;
    alternating|directional) solve "$1" "$1" clean "$studio/linear" "$true" ;;
    chain) ln -sfn "$take/solve/standard" "$out/chain" ;;
    chain-*) solve "$1" "${1#chain-}" chain "$take/linear" "$take/panorama.exr" ;;
    images) solve images joint chain "$take/linear" "$true" ;;
    panorama) solve panorama joint clean "$studio/linear" "$take/panorama.exr" ;;
    noiseless) through_sensors "$1" $fine --ahd full_well_e=1e7 read_noise_e=0; solve "$1" joint clean "$out/$1-linear" "$true" ;;
    bilinear) through_sensors "$1" $fine --bilinear; solve "$1" joint clean "$out/$1-linear" "$true" ;;
    half) through_sensors "$1" $fine --half; solve "$1" joint clean "$out/$1-linear" "$true" ;;
    coarse) through_sensors "$1" "${w}x$h" --ahd; solve "$1" joint clean "$out/$1-linear" "$true" ;;
    *) say "variant '$1' is not known"; exit 2 ;;
    esac
}

judge() { # NAME: $out/NAME.judge (JSON) and .regions
    solved=$out/$1
    [ ! "$out/$1.regions" -nt "$solved/report.json" ] || return 0
    lights="--lights $studio/relit/lights.json"
    if [ -f "$studio/relit/panels.json" ] || grep -q '"panels"' "$studio/relit/lights.json"; then
        panels=$studio/relit/panels.json
        [ -f "$panels" ] || panels=$studio/relit/lights.json
        lights="--panorama $studio/relit/panorama.exr --world-from-probe $studio/relit/probe.json --panels $panels -n 4096"
    fi
    say "$name $1: judged"
    # shellcheck disable=SC2086
    "$bin/rigsolve" render "$solved" --cameras "$studio/relit/cameras" $lights -o "$out/relit-$1" >>"$out/$1.log" 2>&1
    "$tools/judge" "$solved" "$studio" --json >"$out/$1.judge"
    "$tools/judge_materials" "$solved" "$studio" "$out/relit-$1" >"$out/$1.regions.part"
    mv "$out/$1.regions.part" "$out/$1.regions"
}

row() { # NAME
    tr -d ' \n' <"$out/$1.judge" >"$out/row"
    of() { sed -n "s/.*\"$1\":\([^,}]*\).*/\1/p" "$out/row"; }
    cpu=$(awk '{ printf "%.0f", $1 + $2 }' "$out/$1.time" 2>/dev/null || echo -)
    awk -v prefix="$name,$1,$(of method | tr -d '"'),$(of trusted),$(of rmse_fit_percent),$(of rmse_held_out_percent),$(sed -n 's/^relit: RMSE \([0-9.]*\) %/\1/p' "$out/$1.regions"),$(of centre_cm),$(of distance_percent),$(of distance_median_percent),$(of distance_weighted_percent),$cpu" '
        function put() { if (region != "") print prefix "," region "," albedo "," p["roughness"] "," p["metallic"] "," p["specular"] }
        /^region/ { put(); region = $2; sub(":", "", region); albedo = ""; next }
        $1 == "albedo" && $2 == "true" { albedo = $9; gsub(/[()%]/, "", albedo) }
        $2 == "true" { p[$1] = $3 "," $5 "," $8 }
        END { put() }' "$out/$1.regions"
    rm "$out/row"
}

echo 'studio,variant,method,trusted,rmse_fit_percent,rmse_held_out_percent,relit_percent,centre_cm,distance_percent,distance_median_percent,distance_weighted_percent,cpu_s,region,albedo_percent,roughness_true,roughness,roughness_rms,metallic_true,metallic,metallic_rms,specular_true,specular,specular_rms' >"$csv.$$"
for studio; do
    [ -d "$studio/truth" ] && [ -d "$studio/linear" ] || { echo "studios: $studio: expected a folder with linear/ and truth/" >&2; exit 2; }
    studio=$(cd "$studio" && pwd)
    name=$(basename "$studio")
    out=$all/$name
    mkdir -p "$out"
    for v in $variants; do
        [ -n "${TABLE-}" ] || [ -f "$out/$v/report.json" ] || make_variant "$v"
        [ -f "$out/$v/report.json" ] || continue
        judge "$v"
        row "$v" >>"$csv.$$"
    done
done
mv "$csv.$$" "$csv"

# What a person reads: one line per variant and region.
awk -F, 'function short(x) { return x == "null" ? "-" : sprintf("%.2f", x) }
    FNR == 1 { next }
    $1 != studio { studio = $1; printf "\n%s\n%-21s %6s %6s %6s %6s %8s %14s   %s\n", $1, "variant", "fit %", "unseen", "relit", "centre", "distance", "median, by flux", "region: albedo %, roughness/metallic/specular found (RMS error) of true" }
    { same = $1 $2 == last; last = $1 $2
      if (same) printf "%-21s %6s %6s %6s %6s %8s %14s", "", "", "", "", "", "", ""
      else printf "%-21s %6.3f %6.3f %6.3f %6s %8s %6s %7s", $2 ($4 == "true" ? "" : " (!)"), $5, $6, $7, short($8), short($9), short($10), short($11)
      printf "   %s: %5.2f  %.3f (%.3f) of %.2f  %.3f (%.3f) of %.2f  %.3f (%.3f) of %.2f\n", $13, $14, $16, $17, $15, $19, $20, $18, $22, $23, $21 }' "$csv"
echo
echo "(!): the solver does not trust its result and says why in its report. centre in cm, distance in %. Table: $csv"
