#!/bin/sh
# tests/test_rig_panorama.sh - a panorama as a user shoots it: rigsim's camera on its head before a studio's lights, rigd, rigctl, and what
# goes wrong meanwhile. Prints TAP. BIN: where the programs are. KILLS=n: how many times the daemon is killed at a random moment.
set -u
KILLS=${KILLS:-1} SEED=${SEED:-1} CAMERAS=3
. tests/chain_setup.sh
# Lights for the camera: a synthetic studio's, so that nothing outside this folder is needed.
"$BIN/rigsolve" synth D1 -o "$D/studio" --size 16x16 >"$D/out" 2>&1 || { echo "1..0 # rigsolve synth: $(tail -1 "$D/out")"; exit 1; }
cat >"$D/faults" <<E
A03 on shot 3 no_shot 1
A03 on shot 5 lose_added 1
A03 on shot 7 dial 0x5007 560
A03 on shot 2 head_stuck 1
A03 on shot 8 drop
E
rigsim="$rigsim --cameras $CAMERAS --seed $SEED --panorama $D/studio/panorama.exr"
{
    rig_section
    cat <<E
[settings]
imageformat = raw
iso = 100
aperture = 8
shutter = 1/125
E
    $rigsim --list | sed 's/^\[panorama\]/&\nstops = 0,0; 45,0\nmeter = 1\/1000\nlongest = 1\/250\nsettle_ms = 100/'
} >"$D/rigd.conf"
newest() { ls -d "$D"/takes/*_"$1" | tail -1; }
# Every exposure of a verified panorama is here once, none half, and its plan names them.
accounts() {
    bad=0
    for t in "$D"/takes/*/; do
        [ -d "$t/panorama" ] || continue
        grep -q '"state":"verified"' "$t/take.json" || { echo "$t: $(grep -o '"reason":"[^"]*"' "$t/take.json")"; bad=1; }
        [ "$(ls "$t/panorama/raw" | wc -l)" -ge 8 ] || { echo "$t: $(ls "$t/panorama/raw")"; bad=1; }
        frames=$(grep -o 'raw/[0-9_]*\.[a-z]*' "$t/panorama/panorama.json")
        [ -n "$frames" ] || { echo "$t: its plan is empty"; bad=1; }
        for f in $frames; do [ -s "$t/panorama/$f" ] || { echo "$t/panorama/$f is missing"; bad=1; }; done
        "$BIN/rigctl" export "$(basename "$t")" || bad=1
    done
    find "$D/takes" -name '*.part' | grep . && bad=1
    find "$D/takes" -path '*/raw/*' -type f -exec sha256sum {} + | cut -d' ' -f1 | sort | uniq -d | grep . && { echo "a frame is there twice"; bad=1; }
    return $bad
}
start_cameras
start
must "all cameras open" ready
check "a panorama from request to verified" sh -c "timeout 600 $BIN/rigctl panorama --name first 2>$D/steps"
check "it says each step" sh -c "cat $D/steps; grep -q 'stop 2 of 2: to yaw 45' $D/steps && grep -q 'stop 1 of 2: exposure 1, 1/1000 s' $D/steps && grep -q 'stop 2 of 2 is done' $D/steps"
check "its frames and its plan are here" accounts
check "it becomes an EXR without any daemon" sh -c "$BIN/rigctl panorama --merge $(newest first) -o $D/p.exr --json >$D/report; s=\$?; cat $D/report; [ \$s = 0 -o \$s = 3 ] && [ -s $D/p.exr ]"
check "a capture names the newest panorama" sh -c "$BIN/rigctl capture --name vase && grep -q '\"panorama_take\":\"$(basename "$(newest first)")\"' $D/takes/*vase/take.json"
check "and does without its camera" sh -c "ls $D/takes/*vase/raw; [ \"\$(ls $D/takes/*vase/raw | wc -l)\" = 2 ]"
k=0
while [ $k -lt "$KILLS" ]; do
    "$BIN/rigctl" panorama --name "kill$k" >/dev/null 2>&1 &
    ctl=$!
    sleep "$(awk -v s="$SEED" -v k="$k" 'BEGIN { srand(s * 100003 + k); printf "%.3f", 1.2 + rand() * 7 }')"
    start_again
    wait $ctl
    ready >/dev/null || break
    k=$((k + 1))
done
check "$KILLS kills: each panorama went on by itself" test $k = "$KILLS"
check "no exposure is lost, doubled or half there" accounts
kill "$sim" "$rigd"
wait "$sim" "$rigd" 2>/dev/null
start_cameras --faults "$D/faults"
start
must "it opens them again" ready
check "a closed shutter, a lost event, a turned dial, a stuck head, a broken link: it is whole" sh -c "timeout 600 $BIN/rigctl panorama --name faults 2>$D/steps"
check "each is said" sh -c "cat $D/steps; grep -q 'exposed again' $D/steps && grep -q 'head did not reach' $D/steps && grep -q 'aperture' $D/steps"
check "and every exposure is here" accounts
echo "1..$n"
exit $failed
