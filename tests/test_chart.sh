#!/bin/sh
# tests/test_chart.sh - rigsolve chart: its rows, that it goes on where it was, that what fails is said, what it draws. Prints TAP.
# Run from the repository root; BIN is where rigsolve lies.
set -u
. tests/commands_setup.sh
# table FILE PERL: @r are the rows as hashes; every row has as many fields as the header
table() {
    perl -e '($f, $test) = @ARGV; open(F, "<", $f) or die "$f: $!"; chomp(@l = <F>); @h = split /,/, shift @l;
        for (@l) { my @v = split /,/, $_, -1; @v == @h or die "not as many fields as the header: $_\n"; my %r; @r{@h} = @v; push @r, \%r }
        print "$_\n" for @l; exit((eval $test) ? 0 : 1)' "$1" "$2" >>"$dir/log" 2>&1
}

gives 0 "chart --help" "$rigsolve" chart --help
gives 2 "no -o is a usage error" "$rigsolve" chart D3
for bad in --lights=63 --lights=2048 --lights=16,,32 --lights=16, --texture=0 --texture=x --methods=magic --kernels=sse --presets=best --preset-scale=3 --hold-out=3 \
    --hold-out=every:1 --size=12 --views=0 --base-lights=0 --no-such-option; do
    "$rigsolve" chart D3 -o "$dir/refused" $bad >"$dir/log" 2>&1
    [ $? = 2 ] && [ ! -e "$dir/refused" ] || { echo "accepted: $bad" >>"$dir/log"; break; }
    bad=
done
[ -z "$bad" ]
result $? "a value that an option does not take is a usage error"
"$rigsolve" chart D3 -o "$dir/refused" --texture 16,cat >"$dir/log" 2>&1
grep -q "'cat'.*from 4 to 4096" "$dir/log"
result $? "and named, with what is expected"

# A studio that a solve takes a second for
tiny="--size 60x40 --views 12 --hold-out every:4 --base-lights 16 --base-texture 8 --lights 16,32 --texture 8,32 --methods alternating,directional --kernels none --threads 2"
gives 0 "a chart of a tiny studio" "$rigsolve" chart D3 -o "$dir/chart" $tiny --presets preview --preset-scale 8
table "$dir/chart/chart.csv" '@r == 5 && join(" ", map "$_->{axis}:$_->{method}:$_->{preset}:$_->{stage}:$_->{n_lights}:$_->{texture}", @r) eq
    "base:alternating::2:16:8 texture:alternating::2:16:32 lights:alternating::2:32:8 method:directional::2:16:8 preset:joint:preview:1:64:16"'
result $? "has the base, one row for each value that differs from it, and the preset, each with its settings"
table "$dir/chart/chart.csv" '!grep { $_->{set} ne "D3" || $_->{solved} ne "yes" || $_->{n_views} != 12 || $_->{n_held_out} != 3 || $_->{width_px} != 60 || $_->{cpu_s} <= 0 ||
    $_->{peak_rss_bytes} < 1e7 || $_->{rmse_held_out_percent} <= 0 || $_->{rmse_pictures_percent} <= 0 || $_->{n_observations} < 1 || $_->{kernel} !~ /^\w+$/ } @r'
result $? "every row has its figures"
table "$dir/chart/chart.csv" '($b, $fine) = @r; $fine->{rmse_pictures_percent} < .8 * $b->{rmse_pictures_percent}'
result $? "a finer texture shows in the pictures"
[ "$(head -c 4 "$dir/chart/chart.png" | tail -c 3)" = PNG ] && grep -q '</svg>' "$dir/chart/chart.svg"
result $? "PNG and SVG are drawn"
perl -0777 -ne '%n = (); for my $w ("N=32", "texture 32", "base", "directional", "preview (16)") { exit 1 unless () = /set label \x27\Q$w\E\x27/g }' "$dir/chart/chart.gp"
result $? "with every row by its name"
[ -z "$(ls "$dir/chart/solves" | grep -v '\.log$')" ]
result $? "the solves themselves are gone"
# A row's trust is its mark: filled or hollow
table "$dir/chart/chart.csv" 'local $/; open(G, "<", $f =~ s/csv$/gp/r); $g = <G>; ($points) = $g =~ /\$points0_5 << EOD\n(.*?)\n/; (split / /, $points)[2] == ($r[4]{trusted} eq "yes" ? 15 : 14)'
result $? "a solve that is not to be trusted is drawn hollow"

cp "$dir/chart/chart.csv" "$dir/before.csv"
rm "$dir/chart/solves/"*.log "$dir/chart/chart.png"
gives 0 "the same chart again" "$rigsolve" chart D3 -o "$dir/chart" $tiny --presets preview --preset-scale 8
cmp "$dir/before.csv" "$dir/chart/chart.csv" >"$dir/log" 2>&1 && [ -z "$(ls "$dir/chart/solves")" ] && [ -s "$dir/chart/chart.png" ]
result $? "solves nothing again, and draws"
gives 0 "the same chart with one texture more" "$rigsolve" chart D3 -o "$dir/chart" $tiny --presets none --texture 8,16,32 --json
[ "$(ls "$dir/chart/solves")" = D3-texture_16.log ] && table "$dir/chart/chart.csv" '@r == 6 && $r[5]{texture} == 16'
result $? "solves that one alone, and keeps the others"
perl -MJSON::PP -ne 'next unless /^\[/; $d = decode_json($_); exit(@$d == 5 && $d->[0]{axis} eq "base" && $d->[0]{cpu_s} > 0 && exists $d->[0]{on_front_of_pictures} ? 0 : 1)' "$dir/log"
result $? "its JSON lists what was asked for"
gives 0 "a chart of rows that are there and of one that is not, without solving" "$rigsolve" chart D3 -o "$dir/chart" $tiny --presets none --texture 16,64 --no-solve
[ "$(ls "$dir/chart/solves")" = D3-texture_16.log ] && grep -q "'texture 16'" "$dir/chart/chart.gp" && ! grep -q "'texture 64'" "$dir/chart/chart.gp"
result $? "draws those that are there"
gives 1 "nothing to draw is refused" "$rigsolve" chart D3 -o "$dir/chart" $tiny --no-solve --seed 2
sed -i '2d' "$dir/chart/chart.csv"
gives 0 "a row taken out of the table" "$rigsolve" chart D3 -o "$dir/chart" $tiny --presets none
table "$dir/chart/chart.csv" '@r == 6 && $r[5]{axis} eq "base"'
result $? "is solved again"

# Killed in the middle
"$rigsolve" chart D3 -o "$dir/torn" $tiny --presets none >"$dir/log" 2>&1 &
pid=$!
i=0
while [ ! -s "$dir/torn/chart.csv" ] && [ $i -lt 300 ]; do
    i=$((i + 1))
    sleep .2
done
kill -9 $pid 2>/dev/null
wait $pid 2>/dev/null
table "$dir/torn/chart.csv" '@r >= 1'
result $? "a chart that was killed leaves whole rows"
gives 0 "and goes on" "$rigsolve" chart D3 -o "$dir/torn" $tiny --presets none
table "$dir/torn/chart.csv" '@r == 4'
result $? "to its end"
cut -d, -f1-8,20-22 "$dir/torn/chart.csv" | head -n 5 | LC_ALL=C sort >"$dir/one" && cut -d, -f1-8,20-22 "$dir/before.csv" | head -n 5 | LC_ALL=C sort >"$dir/two" && cmp "$dir/one" "$dir/two" >"$dir/log" 2>&1
result $? "with the errors of one that was not"

# A take that cannot be solved is a row, and the others are solved all the same
one=$dir/chart/takes/D3-60x40-12-1
cp -r "$one" "$dir/broken, really" && head -c 3000 "$one/panorama.exr" >"$dir/broken, really/panorama.exr"
cp -r "$one" "$dir/own"
few="--hold-out every:4 --base-lights 16 --base-texture 8 --lights none --texture none --methods alternating --kernels none --presets none --threads 2"
gives 0 "a take that cannot be solved beside one that can" "$rigsolve" chart "$dir/broken, really/" "$dir/own" -o "$dir/both" $few
table "$dir/both/chart.csv" '@r == 2 && $r[0]{set} eq "broken__really" && $r[0]{solved} eq "no" && $r[0]{trusted} eq "no" && $r[0]{stop_reason} =~ /panorama\.exr/ && $r[0]{rmse_held_out_percent} eq "" &&
    $r[1]{set} eq "own" && $r[1]{solved} eq "yes"'
result $? "is a row that says why"
grep -q "no figure: base" "$dir/both/chart.gp" && [ -s "$dir/both/chart.png" ]
result $? "and the chart says so"
gives 1 "a take that is not there is refused" "$rigsolve" chart "$dir/nowhere" -o "$dir/none" $few
gives 1 "two takes of one name are refused" "$rigsolve" chart "$dir/own" "$dir/own/" -o "$dir/none" $few
mkdir "$dir/foreign" && printf 'a,b\n1,2\n' >"$dir/foreign/chart.csv"
gives 1 "a chart.csv of something else is refused" "$rigsolve" chart "$dir/own" -o "$dir/foreign" $few
grep -q 'chart\.csv' "$dir/log" && [ "$(cat "$dir/foreign/chart.csv")" = "$(printf 'a,b\n1,2\n')" ]
result $? "by its name, and left as it was"
rm "$dir/both/chart.png" "$dir/both/chart.svg" "$dir/both/chart.gp"
gives 0 "without gnuplot a chart is a table" env PATH=/nonexistent "$(realpath "$rigsolve")" chart "$dir/broken, really" "$dir/own" -o "$dir/both" $few
grep -q 'gnuplot-nox' "$dir/log" && [ -s "$dir/both/chart.gp" ] && [ ! -e "$dir/both/chart.png" ]
result $? "and says what to install"
echo "1..$n"
exit $failed
