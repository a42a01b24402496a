#!/bin/sh
# tests/test_commands.sh - rigsolve as a user meets it: every command on a small studio, exit codes, bad input. Prints TAP.
# Run from the repository root; BIN is where rigsolve lies.
set -u
. tests/commands_setup.sh
# refuses NAME PATTERN COMMAND...: exit code 1, and the message says what the pattern says; nothing on the final name $dir/refused
refuses() {
    name=$1 pattern=$2
    shift 2
    "$@" >"$dir/log" 2>&1 </dev/null
    got=$?
    [ "$got" = 1 ] && grep -qiE "$pattern" "$dir/log" && [ ! -e "$dir/refused" ]
    result $? "$name"
}
json_has() { # file, perl expression on $d
    perl -MJSON::PP -0777 -ne '$d = decode_json($_); exit(('"$2"') ? 0 : 1)' "$1" >>"$dir/log" 2>&1
}
sums() { # content of a folder, without names of where it is
    (cd "$1" && find . -type f ! -name take.json ! -name report.json | LC_ALL=C sort | xargs cksum)
}

gives 0 "help" "$rigsolve" --help
gives 0 "version" "$rigsolve" --version
gives 2 "no command is a usage error" "$rigsolve"
gives 2 "an unknown command is a usage error" "$rigsolve" paint
for c in brdf lights visibility synth solve render export report compare; do
    gives 0 "$c --help" "$rigsolve" $c --help
    gives 2 "$c without arguments is a usage error" "$rigsolve" $c
    gives 2 "$c with an unknown option is a usage error" "$rigsolve" $c --no-such-option
done

small="--size 60x40 --views 10 --true-lights 256 --texture 64 --panorama-width 256 --samples 1"
# counts_rows N NAME: what was said on descriptor 3 ends with so many rows of pictures, all done
counts_rows() {
    tail -n 1 "$dir/progress" >"$dir/log"
    grep -q "\"done\":$1,\"total\":$1," "$dir/log"
    result $? "$2"
}
tells="env STUDIORIG_PROGRESS_FD=3 $rigsolve"
gives 0 "synth makes a studio" $tells synth D3 -o "$dir/one" --seed 7 --threads 1 $small 3>"$dir/progress"
counts_rows 640 "and says how far it is row by row: a picture may take longer than anyone wants to wait for a word"
gives 0 "synth makes it again with other threads" "$rigsolve" synth D3 -o "$dir/two" --seed 7 --threads 3 $small
sums "$dir/one" >"$dir/sums1" && sums "$dir/two" >"$dir/sums2" && [ -s "$dir/sums1" ] && cmp "$dir/sums1" "$dir/sums2" >"$dir/log" 2>&1
result $? "same seed, same bytes, whatever the thread count"
gives 1 "synth does not write into a folder that has something" "$rigsolve" synth D3 -o "$dir/one" $small
gives 2 "synth names a data set it does not know" "$rigsolve" synth D9 -o "$dir/refused"

gives 0 "lights" "$rigsolve" lights "$dir/one/panorama.exr" -n 64 -o "$dir/lights.json" --overlay "$dir/lights.png"
json_has "$dir/lights.json" 'ref $d eq "ARRAY" && @$d == 64 && @{$d->[0]{irradiance}} == 3'
result $? "lights.json lists 64 lights"
gives 2 "lights refuses a count that is no power of two" "$rigsolve" lights "$dir/one/panorama.exr" -n 100 -o "$dir/refused"
gives 0 "visibility of a take" "$rigsolve" visibility "$dir/one" -o "$dir/vis" --texture 64 --lights 64
[ -s "$dir/vis/visibility/cam000.png" ] && [ -s "$dir/vis/visibility/lights.bin" ]
result $? "visibility leaves one mask per view and the light bits"
gives 0 "render of the truth by the take's cameras" $tells render "$dir/one/truth" --cameras "$dir/one/geometry/cameras" \
    -o "$dir/views" --samples 1 3>"$dir/progress"
counts_rows 400 "and says how far it is row by row"
"$rigsolve" compare "$dir/views" "$dir/one/linear" --json >"$dir/compare.json" 2>"$dir/log"
result $? "compare of two folders"
json_has "$dir/compare.json" '$d->{rmse_percent} < .1 || do { print "RMSE $d->{rmse_percent} %\n"; 0 }'
result $? "the render of the truth is what synth wrote, to the rounding of half floats"

gives 0 "synth makes a diffuse studio" "$rigsolve" synth D2 -o "$dir/diffuse" --size 120x80 --views 20 --true-lights 4096 --texture 64 --samples 1
known="--reflectance lambert --albedo .5 --texture 32 --lights 64"
gives 0 "solve finds the lights of a diffuse object of known albedo" "$rigsolve" solve "$dir/diffuse" -o "$dir/solve" $known --threads 1
json_has "$dir/solve/report.json" '$d->{trusted} && $d->{rmse_held_out_percent} < .3 && @{$d->{warnings}} == 0 && $d->{method} eq "joint"'
result $? "its report says so"
perl -MJSON::PP -e 'my ($r, $p) = map { open(my $f, "<", $_) or die; local $/; decode_json(<$f>) } @ARGV;
    my $d2 = 0; $d2 += ($r->{centre_m}[$_] - $p->{centre_m}[$_]) ** 2 for 0 .. 2; print "centre off by ", 100 * sqrt($d2), " cm\n"; exit($d2 < .05 ** 2 ? 0 : 1)' \
    "$dir/solve/report.json" "$dir/diffuse/truth/probe.json" >"$dir/log" 2>&1
result $? "the probe's place is found within 5 cm, from a start 44 cm away"
gives 0 "solve again with other threads" "$rigsolve" solve "$dir/diffuse" -o "$dir/solve3" $known --threads 3
cmp "$dir/solve/lights.json" "$dir/solve3/lights.json" >"$dir/log" 2>&1 && cmp "$dir/solve/albedo.exr" "$dir/solve3/albedo.exr" >>"$dir/log" 2>&1
result $? "same lights and albedo, to the byte"
gives 3 "a diffuse object of unknown albedo: solved as far as it goes, not to be trusted" "$rigsolve" solve "$dir/diffuse" -o "$dir/solve0" \
    --reflectance lambert --texture 32 --lights 64
gives 0 "render of what was solved" "$rigsolve" render "$dir/solve" --cameras "$dir/diffuse/geometry/cameras" -o "$dir/solved" --samples 1

# Stage 2 under the true lights
under="--lights-from $dir/one/truth/lights.json --texture 32"
gives 0 "solve finds textures under lights that are given" "$rigsolve" solve "$dir/one" -o "$dir/textures" $under --threads 1
json_has "$dir/textures/report.json" '($m = $d->{stages}{materials}) && $m->{rmse_fit_percent} < 1 && @{$m->{regions}} == 1 &&
    abs($m->{regions}[0]{theta}{roughness} - .6) < .05 && $m->{regions}[0]{model}{roughness} =~ /^(tied|free)$/ && @{$m->{levels}} >= 6'
result $? "one region, its roughness, every level reported"
json_has "$dir/textures/report.json" '($a = $d->{stages}{materials}{most_directional_albedo}) > .3 && $a < 1 && !grep { /makes light/ } @{$d->{warnings}}'
result $? "materials that keep their light give no warning"
json_has "$dir/textures/report.json" '@{$d->{warnings}} == 1 && $d->{warnings}[0] =~ /too tight for 32 x 32 texels.*0\.7 texels apart.*--texture 9\d or more/'
result $? "charts that 32 texels cannot keep apart do, and how many would is said"
perl -0777 -pe 's{("irradiance": *\[)([^]]*)}{$1 . join ",", map { $_ / 4 } split /,/, $2}ge' "$dir/one/truth/lights.json" >"$dir/dim.json"
gives 0 "solve under a quarter of the light" "$rigsolve" solve "$dir/one" -o "$dir/bright" $under --lights-from "$dir/dim.json"
json_has "$dir/bright/report.json" '$d->{stages}{materials}{most_directional_albedo} > 1 && grep { /makes light/ } @{$d->{warnings}}'
result $? "materials that would have to make light are warned of"
gives 0 "solve again with other threads" "$rigsolve" solve "$dir/one" -o "$dir/textures3" $under --threads 3
for f in albedo brdf std validity; do cmp "$dir/textures/$f.exr" "$dir/textures3/$f.exr" || break; done >"$dir/log" 2>&1
result $? "same textures, to the byte"
gives 0 "the paper's plain fit" "$rigsolve" solve "$dir/one" -o "$dir/plain" $under --method alternating
json_has "$dir/plain/report.json" '@{$d->{stages}{materials}{regions}} == 0'
result $? "without regions"
"$rigsolve" solve "$dir/one" -o "$dir/far" --method directional --texture 32 --lights 64 >"$dir/log" 2>&1
got=$?
[ $got = 0 ] || [ $got = 3 ] && [ -s "$dir/far/std.exr" ]
result $? "directional lights leave the centre open, and textures with finite doubts all the same"
gives 2 "no stage 1 and nothing after it is a usage error" "$rigsolve" solve "$dir/one" -o "$dir/refused" --lights-from x --stage 1
refuses "lights that are not there are named" 'nowhere\.json' "$rigsolve" solve "$dir/one" -o "$dir/refused" --lights-from "$dir/nowhere.json"
# Killed at any moment: no file that is not whole, and a second run as if nothing had been
mkdir "$dir/torn"
for pause in .05 .2 .4 .8; do
    "$rigsolve" solve "$dir/one" -o "$dir/torn" $under --threads 1 >"$dir/log" 2>&1 &
    pid=$!
    sleep $pause
    kill -9 $pid 2>/dev/null
    wait $pid 2>/dev/null
    for f in albedo brdf std validity; do
        [ ! -e "$dir/torn/$f.exr" ] || cmp "$dir/torn/$f.exr" "$dir/textures/$f.exr" >>"$dir/log" 2>&1 || pause=torn
    done
    [ $pause = torn ] && break
done
[ $pause = .8 ] && "$rigsolve" solve "$dir/one" -o "$dir/torn" $under --threads 1 >>"$dir/log" 2>&1 && cmp "$dir/torn/brdf.exr" "$dir/textures/brdf.exr" >>"$dir/log" 2>&1
result $? "a solve that was killed leaves whole files or none, and runs again"

# Input as it comes from the world
head -c 2000 "$dir/one/panorama.exr" >"$dir/cut.exr"
refuses "a truncated EXR is refused by name" 'cut\.exr' "$rigsolve" lights "$dir/cut.exr" -n 64 -o "$dir/refused"
refuses "a view is no panorama: not 2:1" 'cam000\.exr.*2:1' "$rigsolve" lights "$dir/one/linear/cam000.exr" -n 64 -o "$dir/refused"
refuses "a missing file is named" 'nowhere\.exr' "$rigsolve" lights "$dir/nowhere.exr" -n 64 -o "$dir/refused"
printf '#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n' >"$dir/black.hdr"
head -c 32 /dev/zero >>"$dir/black.hdr"
refuses "an all-black panorama is refused" 'black\.hdr.*black' "$rigsolve" lights "$dir/black.hdr" -n 2 -o "$dir/refused"
cameras="$dir/one/geometry/cameras"
vis() { "$rigsolve" visibility --mesh "$1" --cameras "$2" -o "$dir/refused" --texture 32; }
grep -v '^vt' "$dir/one/geometry/mesh.obj" | sed 's,/[0-9]*/,//,g' >"$dir/nouv.obj"
refuses "a mesh without UVs is refused" 'nouv\.obj.*UV' vis "$dir/nouv.obj" "$cameras"
lines=$(wc -l <"$dir/one/geometry/mesh.obj")
head -n $((lines - 5)) "$dir/one/geometry/mesh.obj" >"$dir/cut.obj" && printf 'f 1/1/1 2/' >>"$dir/cut.obj"
refuses "a truncated OBJ is refused with its line" "cut\.obj.* line $((lines - 4))" vis "$dir/cut.obj" "$cameras"
mkdir -p "$dir/cutcams" && cp "$cameras"/*.txt "$dir/cutcams" && head -c 700 "$cameras/images.txt" >"$dir/cutcams/images.txt"
refuses "truncated cameras are refused by file" 'images\.txt' vis "$dir/one/geometry/mesh.obj" "$dir/cutcams"
sed 's/^v [^ ]*/v nan/' "$dir/one/geometry/mesh.obj" >"$dir/nan.obj"
refuses "NaN positions are refused" 'nan\.obj' vis "$dir/nan.obj" "$cameras"
printf 'n_x,n_y\n1,0\n' >"$dir/cases.csv"
refuses "a table of cases without its columns is refused" 'cases\.csv.*column' "$rigsolve" brdf "$dir/cases.csv"
mkdir -p "$dir/away" && sed -E '/^#/!{/^[0-9]/s/^([0-9]+ [^ ]+ [^ ]+ [^ ]+ [^ ]+) [^ ]+ [^ ]+ [^ ]+/\1 0 0 -500/}' "$cameras/images.txt" >"$dir/away/images.txt"
cp "$cameras/cameras.txt" "$cameras/points3D.txt" "$dir/away"
refuses "cameras that do not see the mesh are refused with every hit rate" 'does not see.*as it is 0\.0%.*mirrored' \
    vis "$dir/one/geometry/mesh.obj" "$dir/away"

# The same take with another tool's cameras: Bundler's, whose names and sizes come from elsewhere
cp -r "$dir/one" "$dir/bundler" && rm -r "$dir/bundler/geometry/cameras"
perl -e 'open C, "$ARGV[0]/cameras.txt"; open I, "$ARGV[0]/images.txt"; for (<C>) { next if /^#/; @c = split; $f{$c[0]} = $c[4]; }
    for (<I>) { next if /^#/ or !/\S/; ($id, $w, $x, $y, $z, @t[0..2], $c, $n) = split; push @n, $n;
        @R = (1-2*($y*$y+$z*$z), 2*($x*$y-$w*$z), 2*($x*$z+$w*$y), 2*($x*$y+$w*$z), 1-2*($x*$x+$z*$z), 2*($y*$z-$w*$x),
              2*($x*$z-$w*$y), 2*($y*$z+$w*$x), 1-2*($x*$x+$y*$y));
        $o .= "$f{$c} 0 0\n@R[0..2]\n".join(" ", map -$_, @R[3..5])."\n".join(" ", map -$_, @R[6..8])."\n$t[0] ".-$t[1]." ".-$t[2]."\n"; }
    open O, ">$ARGV[1]/bundle.out"; print O "# Bundle file v0.3\n".@n." 0\n$o"; open O, ">$ARGV[1]/list.txt"; print O "$_\n" for @n;' \
    "$cameras" "$dir/bundler/geometry"
gives 0 "visibility of a take" "$rigsolve" visibility "$dir/one" -o "$dir/seen1" --texture 32 --lights 4
gives 0 "visibility of the same take with Bundler's cameras" "$rigsolve" visibility "$dir/bundler" -o "$dir/seen2" --texture 32 --lights 4
sums "$dir/seen1" | cut -d' ' -f1,2 >"$dir/sums1" && sums "$dir/seen2" | cut -d' ' -f1,2 >"$dir/sums2" && [ -s "$dir/sums1" ] &&
    cmp "$dir/sums1" "$dir/sums2" >"$dir/log" 2>&1
result $? "cameras from another tool's file, the same visibility"
refuses "Bundler without its list is refused by name" 'list\.txt' vis "$dir/one/geometry/mesh.obj" "$(mkdir -p "$dir/nolist" &&
    cp "$dir/bundler/geometry/bundle.out" "$dir/nolist" && echo "$dir/nolist")"

# A writer that is killed leaves nothing under the final name
"$rigsolve" synth D3 -o "$dir/killed" --size 600x400 --true-lights 4096 >/dev/null 2>&1 &
pid=$!
sleep 1
kill -9 $pid 2>/dev/null
wait $pid 2>/dev/null
: >"$dir/log"
[ ! -e "$dir/killed" ]
result $? "a killed synth leaves no folder that looks finished"

# Export, turntable, report
gives 0 "export in every format" "$rigsolve" export "$dir/one/truth" -o "$dir/export" --json
json_has "$dir/log" '$d->{rmse_percent} > 0 && $d->{rmse_percent} < $d->{rmse_by_name_percent}'
result $? "its summary says what the fit to glTF's reflectance costs, and that copying by name would cost more"
[ -s "$dir/export/model.glb" ] && [ -s "$dir/export/model.mtlx" ] && [ -s "$dir/export/model.obj" ] && [ -s "$dir/export/model.mtl" ] &&
    [ -s "$dir/export/albedo.exr" ] && [ -s "$dir/export/lights.json" ] && json_has "$dir/export/export.json" '@{$d->{formats}} == 4'
result $? "export leaves a file for each"
gives 0 "the GLB is a mesh that visibility reads" "$rigsolve" visibility --mesh "$dir/export/model.glb" --cameras "$cameras" -o "$dir/glbvis" --texture 32
gives 2 "export names a format it does not know" "$rigsolve" export "$dir/one/truth" -o "$dir/refused" --formats glb,fbx
refuses "export says which folder has no solve" 'nowhere' "$rigsolve" export "$dir/nowhere" -o "$dir/refused"
refuses "export says which mesh is gone" 'gone\.obj' "$rigsolve" export "$dir/one/truth" -o "$dir/refused" --mesh "$dir/gone.obj"
gives 0 "export into the solve's own folder" "$rigsolve" export "$dir/solve" --formats glb,mtlx
cmp "$dir/solve/albedo.exr" "$dir/solve3/albedo.exr" >"$dir/log" 2>&1 && [ -s "$dir/solve/model.glb" ]
result $? "whose albedo stays as it was"
# A quarter turn of the object before a camera that stands still, once by --turntable, once by a mesh that was turned.
perl -ne 'push @l, $_; if (/^v (\S+) (\S+) (\S+)/) { for my $k (0, 1) { my $x = ($1, $2)[$k]; $a[$k] = $x if !defined $a[$k] || $x < $a[$k]; $b[$k] = $x if !defined $b[$k] || $x > $b[$k] } }
    END { my @c = map { ($a[$_] + $b[$_]) / 2 } 0, 1; for (@l) { if (/^v (\S+) (\S+) (\S+)/) { printf "v %.9g %.9g %.9g\n", $c[0] - ($2 - $c[1]), $c[1] + ($1 - $c[0]), $3 }
        elsif (/^vn (\S+) (\S+) (\S+)/) { printf "vn %.9g %.9g %.9g\n", -$2, $1, $3 } else { print } } }' "$dir/one/geometry/mesh.obj" >"$dir/turned.obj"
gives 0 "render on a turntable" "$rigsolve" render "$dir/one/truth" --turntable 4 --cameras "$cameras" -o "$dir/turn" --samples 1
gives 0 "render of the turned mesh" "$rigsolve" render "$dir/one/truth" --mesh "$dir/turned.obj" --cameras "$cameras" -o "$dir/turned" --samples 1
"$rigsolve" compare "$dir/turn/turn001.exr" "$dir/turned/cam000.exr" --json >"$dir/compare.json" 2>"$dir/log"
json_has "$dir/compare.json" '$d->{rmse_percent} < .2 || do { print "RMSE $d->{rmse_percent} %\n"; 0 }'
result $? "a turntable turns the object against the clock, before camera and light that stand still"
"$rigsolve" compare "$dir/turn/turn001.exr" "$dir/views/cam000.exr" --json >"$dir/compare.json" 2>"$dir/log"
json_has "$dir/compare.json" '$d->{rmse_percent} > 1 || do { print "RMSE $d->{rmse_percent} %\n"; 0 }'
result $? "and one that has turned looks different"
gives 0 "a turntable finds a camera of its own" "$rigsolve" render "$dir/one/truth" --turntable 1 -o "$dir/own" --samples 1 --size 80x60
gives 0 "light turned all the way round" "$rigsolve" render "$dir/one/truth" --cameras "$cameras" --turn-lights 360 -o "$dir/round" --samples 1
"$rigsolve" compare "$dir/round/cam003.exr" "$dir/views/cam003.exr" --json >"$dir/compare.json" 2>"$dir/log"
json_has "$dir/compare.json" '$d->{rmse_percent} < .01'
result $? "is where it was"
# The same object photographed under other light: by its lights, and by its panorama with the panels that say how far it is
other="--cameras $dir/one/relit/cameras --samples 1"
gives 0 "render under other lights" "$rigsolve" render "$dir/one/truth" $other --lights "$dir/one/relit/lights.json" -o "$dir/moved"
"$rigsolve" compare "$dir/moved" "$dir/one/relit/linear" --json >"$dir/compare.json" 2>"$dir/log"
json_has "$dir/compare.json" '$d->{rmse_percent} < .1 || do { print "RMSE $d->{rmse_percent} %\n"; 0 }'
result $? "gives what was photographed there, to the rounding of half floats"
gives 0 "render under another panorama" "$rigsolve" render "$dir/one/truth" $other --panorama "$dir/one/relit/panorama.exr" \
    --world-from-probe "$dir/one/relit/probe.json" --panels "$dir/one/relit/panels.json" -n 256 -o "$dir/sky"
"$rigsolve" compare "$dir/sky" "$dir/one/relit/linear" --json >"$dir/compare.json" 2>"$dir/log"
json_has "$dir/compare.json" '$d->{rmse_percent} < .5 || do { print "RMSE $d->{rmse_percent} %\n"; 0 }'
result $? "gives it too, but for the cut into 256 lights"
gives 2 "render without cameras or turntable is a usage error" "$rigsolve" render "$dir/one/truth" -o "$dir/refused"
gives 0 "report with the take's photographs" "$rigsolve" report "$dir/solve" --take "$dir/diffuse"
[ "$(grep -c 'the photograph' "$dir/solve/report.html")" = 4 ] && ! grep -qE '<script|http' "$dir/solve/report.html"
result $? "shows four of them and needs nothing but itself"
gives 0 "render of the solve, finer than the take's cameras" "$rigsolve" render "$dir/solve" --cameras "$dir/diffuse/geometry/cameras" --size 240x160 -o "$dir/finer"
gives 0 "report with photographs finer than their cameras" "$rigsolve" report "$dir/solve" --take "$dir/diffuse" --images "$dir/finer" -o "$dir/finer.html"
perl -0777 -ne '@r = /RMSE ([\d.]+) %/g; print "RMSE @r %\n"; exit(@r == 4 && !grep({ $_ > 1 } @r) ? 0 : 1)' "$dir/finer.html" >>"$dir/log" 2>&1
result $? "shows them, each seen by its own camera"
grep -o '<h1>[^<]*' "$dir/finer.html" >"$dir/log"
[ "$(cat "$dir/log")" = '<h1>diffuse, standard' ]
result $? "and is called by its take and preset"
perl -MJSON::PP -0777 -ne '$d = decode_json($_); $d->{views_held_out} = ["cam006"]; print encode_json($d)' "$dir/solve/report.json" >"$dir/solve3/report.json"
gives 0 "report of a solve that set a view aside" "$rigsolve" report "$dir/solve3" --take "$dir/diffuse"
grep -q '<h3>cam006 <small>(set aside' "$dir/solve3/report.html"
result $? "shows that view, and says so"
perl -MJSON::PP -i -0777 -pe '$d = decode_json($_); delete $d->{inputs}{take}; delete $d->{inputs}{images}; $_ = encode_json($d)' "$dir/solve0/report.json"
gives 0 "report without a take" "$rigsolve" report "$dir/solve0" -o "$dir/bare.html"
grep -q 'not to be trusted' "$dir/bare.html" && ! grep -q 'the photograph' "$dir/bare.html"
result $? "shows none, and says when not to believe a result"
refuses "report says which folder has no solve" 'nowhere' "$rigsolve" report "$dir/nowhere" -o "$dir/refused"
echo "1..$n"
exit $failed
