#!/bin/sh
# tests/bench/experiments.sh [--table] [SETS [SEEDS [NOISES [METHODS]]]] - solve synthetic studios (and the path-traced ones) by
# each method and print the judge's figures as a table in Markdown. Run from the repository root.
# Each argument is a list with commas, or "all":
#   SETS     D1,D2,D3 (all); also pebble,vase: ../shared/data/studio-*, which have no seeds and a noise of their own
#   SEEDS    1,2,3 (all)        NOISES   0,.01 (all)        METHODS  directional,alternating,joint (all)
# --table prints what lies there from an earlier run. Environment:
#   SYNTH_OPTIONS  (--size 360x240 --true-lights 65536 --samples 1)  a take is made once for each set, seed, noise and these
#   SOLVE_OPTIONS  added to every solve        TAG  a name for these solves, so that others are kept
#   OUT (build/experiments)  BIN (build/bin)  JUDGE (build/tests/bench/judge)
set -eu
table_only=0
if [ "${1-}" = --table ]; then table_only=1; shift; fi
case ${1-} in -*) sed -n '2,10s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
list() { # what was asked for, all of them
    case ${1:-all} in all) printf '%s' "$2" | tr , ' ' ;; *) printf '%s' "$1" | tr , ' ' ;; esac
}
sets=$(list "${1-}" D1,D2,D3) seeds=$(list "${2-}" 1,2,3) noises=$(list "${3-}" 0,.01)
methods=$(list "${4-}" directional,alternating,joint)
synth_options=${SYNTH_OPTIONS:---size 360x240 --true-lights 65536 --samples 1}
solve_options=${SOLVE_OPTIONS-} tag=${TAG-}
out=${OUT:-build/experiments} rigsolve=${BIN:-build/bin}/rigsolve judge=${JUDGE:-build/tests/bench/judge}
refuse() { echo "experiments: $*" >&2; exit 2; }
for d in $sets; do case $d in D[1-3]|pebble|vase) ;; *) refuse "set '$d': expected D1, D2, D3, pebble or vase" ;; esac; done
for m in $methods; do
    case $m in directional|alternating|joint) ;; *) refuse "method '$m': expected directional, alternating or joint" ;; esac
done
for p in "$rigsolve" "$judge"; do [ -x "$p" ] || refuse "no $p: run make all build/tests/bench/judge"; done
mkdir -p "$out/takes" "$out/solves"
rows=$(mktemp "${TMPDIR:-/tmp}/studiorig-experiments-XXXXXX")
trap 'rm -f "$rows"' EXIT
say() { printf '%s %s\n' "$(date +%H:%M:%S)" "$*" >&2; }

# Sets $take, and makes it if it is not there. synth gives a folder its final name when it is complete.
make_take() { # set, seed, noise
    case $1 in
    pebble|vase) take=../shared/data/studio-$1; [ -d "$take" ] || { say "no $take: left out"; return 1; }; return 0 ;;
    esac
    take=$out/takes/$1-seed$2-noise$3-$(printf '%s' "$synth_options" | sed 's/--//g' | tr -cs 'A-Za-z0-9.' _)
    [ -d "$take" ] || [ $table_only = 1 ] && return 0
    say "$1 seed $2 noise $3: synth"
    # shellcheck disable=SC2086
    "$rigsolve" synth "$1" -o "$take" --seed "$2" --noise "$3" $synth_options || { say "synth failed: left out"; return 1; }
}

# One solve, judged; judge.json is there only if both went well.
solve() { # set, take, folder, method
    case $1 in
    D1|D2) material="--reflectance lambert --albedo .5" ;;
    pebble|vase) material="--hold-out list:$2/unseen.txt" ;;
    *) material= ;;
    esac
    rm -f "$3/judge.json" "$3/judge.part" "$3/lights.json" "$3/report.json" "$3/albedo.exr" "$3/brdf.exr" "$3/validity.exr"
    mkdir -p "$3"
    code=0
    # shellcheck disable=SC2086
    "$rigsolve" solve "$2" -o "$3" --stage 1 --method "$4" $material $solve_options >"$3/log" 2>&1 || code=$?
    case $code in
    0|3) ;;
    *) say "solve failed ($code): $(grep -av '^Try ' "$3/log" | tail -n 1)"; return 0 ;;
    esac
    if "$judge" "$3" "$2" --json >"$3/judge.part" && "$judge" "$3" "$2" >&2; then
        mv "$3/judge.part" "$3/judge.json"
    else
        say "judge failed"
    fi
}

n_runs=0 run=0
for d in $sets; do case $d in
    pebble|vase) n=1 ;;
    *) n=$(($(echo "$seeds" | wc -w) * $(echo "$noises" | wc -w))) ;;
    esac; n_runs=$((n_runs + n * $(echo "$methods" | wc -w))); done

one_take() { # set, seed, noise
    if ! make_take "$1" "$2" "$3"; then
        run=$((run + $(echo "$methods" | wc -w)))
        return 0
    fi
    for m in $methods; do
        run=$((run + 1))
        folder=$out/solves/$(basename "$take")/$m${tag:+-$tag}
        if [ $table_only = 0 ]; then
            say "[$run/$n_runs] $1 seed $2 noise $3: $m${tag:+ ($tag)}"
            solve "$1" "$take" "$folder" "$m"
        fi
        printf '%s\t%s\t%s\t%s\t%s\n' "$1" "$2" "$3" "$m${tag:+ $tag}" "$folder/judge.json" >>"$rows"
    done
}
for d in $sets; do
    case $d in
    pebble|vase) one_take "$d" - - ;;
    *) for s in $seeds; do for n in $noises; do one_take "$d" "$s" "$n"; done; done ;;
    esac
done

perl -MJSON::PP -e '
    sub figure { my ($v, $digits) = @_; defined $v ? sprintf("%.*f", $digits, $v) : "-" }
    print "| set | seed | noise | method | RMSE fit / held-out % | distance % mean (median) | weighted | position cm (weighted) " .
        "| centre cm | rotation deg | theta max, without gloss | gloss (std) | albedo % (scaled) | Jacobians | s |\n";
    print "|", "---|" x 15, "\n";
    while (<>) {
        chomp;
        my ($set, $seed, $noise, $method, $file) = split /\t/;
        my $f;
        if (!open($f, "<", $file)) {
            print "| $set | $seed | $noise | $method | no result |", " |" x 10, "\n";
            next;
        }
        my $j = decode_json(do { local $/; <$f> });
        my ($worst, $name);
        for (sort keys %{$j->{theta_error}}) {
            my $e = $j->{theta_error}{$_};
            next if $_ eq "clearcoatGloss" || !defined $e;
            ($worst, $name) = ($e, $_) if !defined $worst || $e > $worst;
        }
        my $trust = exists $j->{trusted} && !$j->{trusted} ? " (not trusted)" : "";
        print "| ", join(" | ", $set, $seed, $noise, $method . $trust,
            figure($j->{rmse_fit_percent}, 3) . " / " . figure($j->{rmse_held_out_percent}, 3),
            figure($j->{distance_percent}, 2) . " (" . figure($j->{distance_median_percent}, 2) . ")",
            figure($j->{distance_weighted_percent}, 2),
            figure($j->{position_cm}, 2) . " (" . figure($j->{position_weighted_cm}, 2) . ")",
            figure($j->{centre_cm}, 2), figure($j->{rotation_deg}, 3),
            defined $worst ? figure($worst, 4) . " $name" . ($j->{theta_uniform} ? "" : " (of means)") : "-",
            figure($j->{theta_error}{clearcoatGloss}, 3) . " (" . figure($j->{theta_error_in_std}{clearcoatGloss}, 1) . ")",
            figure($j->{albedo_percent}, 2) . " (" . figure($j->{albedo_scaled_percent}, 2) . ")",
            figure($j->{n_jacobians}, 0), figure($j->{wall_s}, 1)), " |\n";
    }' "$rows"
