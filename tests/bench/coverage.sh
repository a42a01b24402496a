#!/bin/sh
# tests/bench/coverage.sh [--table] [SETS [SEEDS [LIGHTS]]] - do 90 % intervals hold the truth nine times in ten? Small studios are solved and every
# parameter's claim compared with the truth, per region and over all; also what a solve costs and its errors. Run from the repository root.
# Each argument is a list with commas:
#   SETS    D3,D5             SEEDS   a list, or a range as 1-20 (default)
#   LIGHTS  true,found: stage 2 under the true lights; stages 1 and 2 (both)
# --table prints what lies there from an earlier run. Environment:
#   SYNTH_OPTIONS  (--size 180x120 --views 24 --true-lights 512 --samples 1 --noise .002)   TEXTURE (D3 48, D5 128)
#   SOLVE_OPTIONS  (--lights 128 --threads 1)  OUT (build/coverage)  BIN (build/bin)  JUDGE (build/tests/bench/judge_materials)
set -eu
table_only=0
if [ "${1-}" = --table ]; then table_only=1; shift; fi
case ${1-} in -*) sed -n '2,10s/^# \{0,1\}//p' "$0"; exit 2 ;; esac
sets=$(printf '%s' "${1:-D3,D5}" | tr , ' ') modes=$(printf '%s' "${3:-true,found}" | tr , ' ')
case ${2:-1-20} in *-*) s=${2:-1-20}; seeds=$(seq "${s%-*}" "${s#*-}") ;; *) seeds=$(printf '%s' "$2" | tr , ' ') ;; esac
synth_options=${SYNTH_OPTIONS:---size 180x120 --views 24 --true-lights 512 --samples 1 --noise .002}
solve_options=${SOLVE_OPTIONS:---lights 128 --threads 1}
out=${OUT:-build/coverage} rigsolve=${BIN:-build/bin}/rigsolve judge=${JUDGE:-build/tests/bench/judge_materials}
refuse() { echo "coverage: $*" >&2; exit 2; }
for d in $sets; do case $d in D3|D5) ;; *) refuse "set '$d': expected D3 or D5" ;; esac; done
for m in $modes; do case $m in true|found) ;; *) refuse "lights '$m': expected true or found" ;; esac; done
for p in "$rigsolve" "$judge"; do [ -x "$p" ] || refuse "no $p: run make all build/tests/bench/judge_materials"; done
mkdir -p "$out"
say() { printf '%s %s\n' "$(date +%H:%M:%S)" "$*" >&2; }
for d in $sets; do
    case $d in D3) texture=${TEXTURE:-48} ;; *) texture=${TEXTURE:-128} ;; esac
    for seed in $seeds; do
        take=$out/take-$d-$seed
        for m in $modes; do
            solve=$out/solve-$d-$seed-$m
            [ $table_only = 1 ] && continue
            # shellcheck disable=SC2086 # options are words
            [ -d "$take" ] || "$rigsolve" synth "$d" -o "$take" --seed "$seed" $synth_options >/dev/null || refuse "synth failed"
            from=; [ "$m" = true ] && from="--lights-from $take/truth/lights.json --bounces 0" # D3 and D5 are rendered without
            [ "$m" = found ] && from="--stage 2"
            code=0
            rm -f "$solve/judged.csv"
            # shellcheck disable=SC2086
            "$rigsolve" solve "$take" -o "$solve" --texture "$texture" --seed "$seed" $solve_options $from >"$solve.log" 2>&1 || code=$?
            case $code in 0|3) "$judge" --csv "$solve" "$take" >"$solve/judged.csv" ;; *) say "$d $seed $m: solve failed ($code)"; continue ;; esac
            say "$d seed $seed, $m lights: done"
        done
    done
done
for d in $sets; do for m in $modes; do for seed in $seeds; do
    [ -s "$out/solve-$d-$seed-$m/judged.csv" ] && printf '%s\t%s\t%s\t%s\n' "$d" "$m" "$seed" "$out/solve-$d-$seed-$m"
done; done; done | perl -MJSON::PP -e '
    my (%group, @order);
    while (<>) {
        chomp;
        my ($set, $mode, $seed, $dir) = split /\t/;
        my $key = "$set, $mode lights";
        push @order, $key if !$group{$key};
        my $g = $group{$key} //= {};
        open(my $f, "<", "$dir/report.json") or die;
        my $r = decode_json(do { local $/; <$f> });
        my $m = $r->{stages}{materials};
        push @{$g->{regions}}, scalar @{$m->{regions}};
        $g->{fit} += $m->{rmse_fit_percent}; $g->{held} += $m->{rmse_held_out_percent}; $g->{cpu} += $r->{cpu_s};
        $g->{rss} = $r->{peak_rss_bytes} if $r->{peak_rss_bytes} > ($g->{rss} // 0);
        $g->{n}++; push @{$g->{seeds}}, $seed; $g->{texture} = $r->{texture}; $g->{method} = $r->{method};
        open($f, "<", "$dir/judged.csv") or die;
        while (<$f>) {
            chomp;
            my ($region, $name, $n, $claimed, $within, $true, $found, $rms, $std) = split /,/;
            my $row = $g->{rows}{"$region,$name"} //= { region => $region, name => $name, claims => 0, within => 0, runs => 0 };
            my $kind = $name eq "albedo" ? "albedo" : $name =~ /^albedo/ ? undef : "parameters";
            $row->{runs}++; $row->{true} += $true; $row->{off2} += $rms ** 2;
            next if !$claimed;
            my $share = $claimed / $n; # of the region: a run counts as much as it claims
            $row->{claims} += $share; $row->{within} += $within / $n; $row->{std} += $std, $row->{n_std}++ if $std ne "inf";
            next if !$kind;
            $g->{$kind}[0] += $share; $g->{$kind}[1] += $within / $n;
        }
    }
    for my $key (@order) {
        my $g = $group{$key};
        printf "\n%s: method %s, texture %d, seeds %s, %.1f CPU s a solve, peak memory %.0f MB, fit %.3f %%, held out %.3f %%, regions %s\n", $key, $g->{method},
            $g->{texture}, join(" ", @{$g->{seeds}}), $g->{cpu} / $g->{n}, $g->{rss} / 1e6, $g->{fit} / $g->{n}, $g->{held} / $g->{n}, join(" ", @{$g->{regions}});
        print "| region | parameter | true | RMS error | mean std | runs that claim | within 90 % |\n|---|---|---|---|---|---|---|\n";
        for my $row (sort { $a->{region} <=> $b->{region} or $a->{name} cmp $b->{name} } values %{$g->{rows}}) {
            printf "| %d | %s | %.3f | %.4f | %s | %.1f of %d | %s |\n", $row->{region}, $row->{name}, $row->{true} / $row->{runs}, sqrt($row->{off2} / $row->{runs}),
                $row->{n_std} ? sprintf("%.4f", $row->{std} / $row->{n_std}) : "-", $row->{claims}, $row->{runs},
                $row->{claims} ? sprintf("%.0f %%", 100 * $row->{within} / $row->{claims}) : "-";
        }
        for my $kind ("parameters", "albedo") {
            printf "%s, %s: %.1f %% of %.1f claims\n", $key, $kind, 100 * $g->{$kind}[1] / $g->{$kind}[0], $g->{$kind}[0] if $g->{$kind}[0];
        }
    }'
