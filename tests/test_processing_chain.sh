#!/bin/sh
# tests/test_processing_chain.sh - what becomes of a take after the button: simulated cameras, the real rigd, rigctl and rigd-contact; developing,
# merging, the hook and solving are stand-ins (below) that can be told to be slow, to refuse or to die. Prints TAP.
# BIN: where the programs are. Takes that are made here by hand have ten-byte frames: nobody but the stand-ins reads them.
set -u
CAMERAS=3
. tests/chain_setup.sh
export RIGD_TOOLS="$D/tools" FAKE="$D/fake"

# ---- stand-ins ----------------------------------------------------------------------------------------------------------------
# Each writes its process number to $FAKE/pid.NAME, waits while $FAKE/slow.NAME exists, and does what $FAKE/do.NAME says, if it is there.
mkdir -p "$D/tools" "$D/fake" "$D/takes"
cat >"$D/tools/stand-in" <<'E1'
begin() {
    echo $$ >"$FAKE/pid.$1"
    echo "$1 $(date +%s.%N) $2" >>"$FAKE/calls"
    while [ -e "$FAKE/slow.$1" ]; do sleep .05; done
    [ -e "$FAKE/do.$1" ] && . "$FAKE/do.$1"
    return 0
}
E1
cat >"$D/tools/rigd-develop" <<'E1'
#!/bin/sh
. "$RIGD_TOOLS/stand-in"
raw='' out=''
while [ $# -gt 2 ]; do shift; done
raw=$1 out=$2
begin develop "$(basename "$out" .exr)"
cp "$RIGD_TOOLS/picture" "$out.part" && mv "$out.part" "$out"
echo '{"ok":true,"clipped_share":0.0125,"warnings":[]}'
E1
cat >"$D/tools/rigd-panorama" <<'E1'
#!/bin/sh
. "$RIGD_TOOLS/stand-in"
begin panorama "$1"
echo '{"findings":[{"doubtful":true,"stop":"s01","text":"the lamp clips: 0.01 sr"}]}' >"${3%.exr}-report.json"
echo panorama >"$3"
exit 3
E1
cat >"$D/tools/rigsolve" <<'E1'
#!/bin/sh
. "$RIGD_TOOLS/stand-in"
out=$4 preset=$6
mkdir -p "$out"
echo half >"$out/half"
begin "$preset" "$2"
echo "{\"stage\":\"joint\",\"done\":3,\"total\":10,\"seconds\":1.5}" >&"$STUDIORIG_PROGRESS_FD"
echo '[1]' >&"$STUDIORIG_PROGRESS_FD" # JSON, but nothing that can be told to people
rm "$out/half"
echo glb >"$out/model.glb"
echo "<html>" >"$out/report.html"
printf '{"trusted": false, "rmse_held_out_percent": 1.5, "warnings": ["too few views"]}' >"$out/report.json"
exit 3
E1
cat >"$D/tools/hook" <<'E1'
#!/bin/sh
. "$RIGD_TOOLS/stand-in"
echo "half a mesh" >"$1/geometry/mesh.obj"
sleep 1000 &
echo $! >"$FAKE/pid.grandchild"
begin hook "$1"
cp "$RIGD_TOOLS/mesh.obj" "$1/geometry/mesh.obj"
echo cameras >"$1/geometry/cameras.csv"
E1
echo "whole mesh" >"$D/tools/mesh.obj"
# one pixel, as PNG
echo iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNk+A8AAQUBAScY42YAAAAASUVORK5CYII= | base64 -d >"$D/tools/picture"
chmod +x "$D"/tools/*
ln -s "$BIN/rigd-contact" "$D/tools/rigd-contact"

rigsim="$rigsim --cameras $CAMERAS --seed 1"
{
    rig_section
    cat <<E1
[develop]
demosaic = half
jobs = 2
[reconstruct]
command = $D/tools/hook
[solve]
preview = on
then = standard
threads = 1
E1
    $rigsim --list
} >"$D/rigd.conf"
start_cameras

start_ready() { start && ready; }
restart_hard() { start_again && ready; }
# A finished take without cameras' help. id kind
make_take() {
    mkdir -p "$D/takes/$1/raw" "$D/takes/$1/linear" "$D/takes/$1/geometry/cameras" "$D/takes/$1/thumbnails"
    cameras=''
    if [ "$2" = panorama ]; then
        mkdir -p "$D/takes/$1/panorama/raw"
        echo '{}' >"$D/takes/$1/panorama/panorama.json"
    else
        for c in A01 A02 A03 A04; do
            printf 'frame of %s' $c >"$D/takes/$1/raw/$c.nef"
            cameras="$cameras${cameras:+,}{\"name\":\"$c\",\"port\":\"usb:1-${c#A0}\",\"expected\":true,\"debt\":\"paid\",\"before\":[],\"settings\":[],\"objects\":[{\"folder\":\"/s\",\"name\":\"$c.NEF\",\"size\":12,\"state\":\"copied\",\"file\":\"raw/$c.nef\",\"xxh128\":\"0000000000000000000000000000${c}0\"}]}"
        done
        cameras=$(echo "$cameras" | sed 's/\(000000000000\)A\(0[0-9]\)0/\1a\20/g')
    fi
    printf '{"format":"studiorig take 1","id":"%s","name":"x","kind":"%s","stops":[],"created":"","state":"verified","objects_per_shot":1,"processing":{"state":"owed","notes":[],"solves":[]},"cameras":[%s]}\n' \
        "$1" "$([ "$2" = panorama ] && echo panorama || echo capture)" "$cameras" >"$D/takes/$1/take.json"
}
settled() { # take: within three minutes
    i=0
    until grep -q '"processing": *{"state": *"\(settled\|cancelled\)"' "$D/takes/$1/take.json"; do
        i=$((i + 1))
        [ $i -lt 1800 ] || { cat "$D/takes/$1/take.json"; "$BIN/rigctl" process "$1"; return 1; }
        sleep .1
    done
}
state_is() { grep -q "\"state\":\"$2\",\"id\"" "$D/takes/$1/take.json" || { cat "$D/takes/$1/take.json"; return 1; }; }
says() { grep -q "$2" "$D/takes/$1/take.json" || { cat "$D/takes/$1/take.json"; return 1; }; }
calls() { grep -c "^$1 .*$2" "$D/fake/calls"; } # how often was that started (for that)?
await() { within 1800 "$@"; }
gone() { ! is_running "$1"; }
leftovers() { # nothing half under a final name, nothing hidden left in a settled take
    find "$D/takes" -name '*.part' | grep . && return 1
    find "$D/takes" -name half | grep . && return 1
    grep -r 'half a mesh' "$D/takes" && return 1
    return 0
}

# ---- stories ------------------------------------------------------------------------------------------------------------------
make_take 20260101T000000000_light panorama
must "rigd starts and takes up what is owed" start_ready
check "a panorama take is merged" settled 20260101T000000000_light
check "and is developed, with what is doubtful said" says 20260101T000000000_light 'not to be trusted: s01: the lamp clips'
check "a take from the button to verified" "$BIN/rigctl" capture --name first
take=$(ls "$D/takes" | grep first)
check "goes on by itself until it is settled" settled "$take"
check "and is solved" state_is "$take" solved
check "each camera has its picture and says what is clipped" sh -c "[ \$(grep -o '\"file\":\"linear/A0[1-3].exr\",\"clipped_share\":0.0125' $D/takes/$take/take.json | wc -l) = 3 ] && [ \$(ls $D/takes/$take/linear | wc -l) = 3 ]"
check "its light is the panorama take's, and it says so" sh -c "cmp $D/takes/$take/panorama.exr $D/takes/20260101T000000000_light/panorama.exr && grep -q '\"panorama_from\":\"20260101T000000000_light\"' $D/takes/$take/take.json"
check "outcome of both solves, and why not to trust them" sh -c "grep -q '\"name\":\"preview\",\"trusted\":false,\"rmse_held_out_percent\":1.5,.*too few views' $D/takes/$take/take.json && grep -q '\"name\":\"standard\"' $D/takes/$take/take.json"
check "a contact sheet of what the cameras showed" sh -c "test -s $D/takes/$take/sheet/thumbnails.png && grep -q '\"camera\": \"A03\"' $D/takes/$take/sheet/thumbnails.json"
check "rigctl report names the pages" sh -c "$BIN/rigctl report $take | grep -q 'page: .*/solve/preview/report.html'"
check "and the time line: from the button on, in order, each stage ends after it began" sh -c "$BIN/rigctl report $take | awk '\$5 == \"took\" { line = line \" \" \$1; if (\$4 < \$2 || \$2 < 0) bad = 1; if (\$1 == \"button\" && \$2 > 0) bad = 1; ended[\$1] = \$4 }
    END { print line; exit bad || line !~ /button exposed thumbnails collected verified / || !ended[\"sheet\"] || !ended[\"develop\"] || !ended[\"preview\"] || !ended[\"standard\"] || ended[\"preview\"] < ended[\"develop\"] || ended[\"standard\"] < ended[\"preview\"] || ended[\"standard\"] > 600 }'"
check "which take.json keeps" sh -c "grep -q '\"time_line\":\[{\"stage\":\"button\",\"began_utc_ms\":[0-9]' $D/takes/$take/take.json"
check "rigctl preview answers with the model" sh -c "$BIN/rigctl preview $take | grep -q 'solve/preview/model.glb'; grep -c . $D/fake/calls"
before=$(wc -l <"$D/fake/calls")
check "what is there is not made again" sh -c "$BIN/rigctl process $take --watch; [ \$(wc -l <$D/fake/calls) = $before ]"
check "the manifest still verifies" "$BIN/rigctl" export "$take"
check "a step is made anew when asked, and what follows from it" sh -c "$BIN/rigctl process $take --again preview --watch; [ \$(grep -c '^preview' $D/fake/calls) = 2 ] && [ \$(grep -c '^hook' $D/fake/calls) = 1 ]"
check "a step that nobody knows is refused" sh -c "! $BIN/rigctl process $take --again nonsense"
check "so is a take that nobody knows" sh -c "! $BIN/rigctl process nonsense"

# A raw that is refused harms nothing else.
cat >"$D/fake/do.develop" <<'E1'
case $out in *A02*) echo "rigd-develop: error: develop: $raw: damaged data at byte 17; fetch it again" >&2; exit 1 ;; esac
E1
make_take 20260202T000000000_refused capture
check "restart" restart_hard
check "a refused raw: the take settles" settled 20260202T000000000_refused
check "is solved from the others" state_is 20260202T000000000_refused solved
check "and names camera, slot and file" says 20260202T000000000_refused 'develop: camera A02 (usb:1-2): develop: .*raw/A02.nef: damaged data at byte 17'
check "rigctl process --watch says failed" sh -c "! $BIN/rigctl process 20260202T000000000_refused --watch"
rm "$D/fake/do.develop"
check "once it can be read, only it is made" sh -c "b=\$(grep -c '^develop' $D/fake/calls); $BIN/rigctl process 20260202T000000000_refused --watch; [ \$(grep -c '^develop' $D/fake/calls) = \$((b + 1)) ]"

# kill -9 of a program, of the daemon, at each stage.
stage=0
for what in develop hook preview standard; do
    stage=$((stage + 1))
    id=2026030${stage}T000000000_$what
    touch "$D/fake/slow.$what"
    rm -f "$D/fake/pid.$what"
    make_take $id capture
    check "$what: rigd starts again" restart_hard || break
    check "$what: under way" await test -s "$D/fake/pid.$what"
    pid=$(cat "$D/fake/pid.$what")
    if [ $what = hook ]; then grandchild=$(cat "$D/fake/pid.grandchild"); fi
    kill -9 "$rigd"
    wait "$rigd" 2>/dev/null
    check "$what: kill -9 of rigd ends it too" await gone "$pid"
    if [ $what = hook ]; then check "hook: and its children" await gone "$grandchild"; fi
    rm -f "$D/fake/pid.$what"
    check "$what: and again" start_ready || break
    check "$what: begun again by the next rigd" await test -s "$D/fake/pid.$what"
    kill -9 "$(cat "$D/fake/pid.$what")"
    rm -f "$D/fake/slow.$what"
    check "$what: killed itself, it is started once more, and all is made" settled $id
    check "$what: the take is solved, nothing is missing" sh -c "grep -q '\"state\":\"solved\",\"id\"' $D/takes/$id/take.json && [ \$(ls $D/takes/$id/linear | wc -l) = 4 ] && grep -q 'whole mesh' $D/takes/$id/geometry/mesh.obj"
done
check "nothing half is left anywhere" leftovers
echo 'kill -9 $$' >"$D/fake/do.preview"
make_take 20260304T000000000_dies capture
check "restart once more" restart_hard
check "a solver that always dies: the take settles" settled 20260304T000000000_dies
check "stays developed, and says so" sh -c "grep -q '\"state\":\"developed\",\"id\"' $D/takes/20260304T000000000_dies/take.json && grep -q 'preview: ended 2 times by a signal' $D/takes/20260304T000000000_dies/take.json"
rm "$D/fake/do.preview"

# Shooting is never harmed; cancel.
touch "$D/fake/slow.standard"
rm -f "$D/fake/pid.standard"
make_take 20260401T000000000_long capture
check "restart for a long solve" restart_hard
check "a long solve is under way" await test -s "$D/fake/pid.standard"
# Looks often, and from before the take on: that lasts a second. One process: a machine that is too busy to start one may start none in time.
perl -e '($pid, $is_looking) = @ARGV; for (1 .. 12000) { open(F, "<", "/proc/$pid/stat") or exit 1; exit 0 if <F> =~ /\) T /;
    if ($_ == 1) { open(G, ">", $is_looking); close G } select(undef, undef, undef, .005) } exit 1' "$(cat "$D/fake/pid.standard")" "$D/looking" &
looker=$!
check "somebody looks" await test -e "$D/looking"
"$BIN/rigctl" capture --name second >"$D/second" 2>&1 &
ctl=$!
check "it is paused while the rig shoots" wait $looker
wait $ctl
check "and the shot is verified" grep -q ': verified' "$D/second"
second=$(ls "$D/takes" | grep second)
check "the new take's preview comes before the old one's long solve" await test -s "$D/takes/$second/solve/preview/report.json"
check "progress is to be seen" sh -c "$BIN/rigctl status | grep -q standard"
check "cancel ends it" sh -c "$BIN/rigctl process 20260401T000000000_long --cancel >/dev/null"
check "durably" settled 20260401T000000000_long
check "as cancelled" says 20260401T000000000_long '"processing":{"state":"cancelled"'
rm -f "$D/fake/slow.standard"
check "the second take is settled" settled "$second"

# What is missing is said, and nothing is started for it.
rm -rf "$D/takes/20260101T000000000_light"
sed -i 's|^command = .*||; s|^\[reconstruct\]||' "$D/rigd.conf"
make_take 20251231T000000000_bare capture
check "restart without a hook" restart_hard
check "a take without panorama and geometry settles" settled 20251231T000000000_bare
check "is developed" state_is 20251231T000000000_bare developed
check "and says what is missing" sh -c "grep -q 'panorama: no panorama take comes before this one' $D/takes/20251231T000000000_bare/take.json && grep -q 'reconstruct: geometry/ has no mesh and no cameras' $D/takes/20251231T000000000_bare/take.json && ! grep -q '^preview.*bare' $D/fake/calls"
echo light >"$D/takes/20251231T000000000_bare/panorama.exr"
echo mesh >"$D/takes/20251231T000000000_bare/geometry/mesh.obj"
echo cameras >"$D/takes/20251231T000000000_bare/geometry/cameras.csv"
check "put there by hand, it goes on" "$BIN/rigctl" process 20251231T000000000_bare --watch
check "to solved, and by hand stays by hand" sh -c "grep -q '\"state\":\"solved\",\"id\"' $D/takes/20251231T000000000_bare/take.json && grep -q mesh $D/takes/20251231T000000000_bare/geometry/mesh.obj"
kill "$rigd" && wait "$rigd"
rigd=''
all_gone() { for p in "$D"/fake/pid.*; do gone "$(cat "$p")" || { ps -fp "$(cat "$p")"; return 1; }; done; }
check "no stand-in is left behind" all_gone
echo "1..$n"
exit $failed
