#!/bin/sh
# tests/test_rig_chain.sh - the whole rig as a user runs it: rigsim's cameras and wires, rigd with its workers, rigctl. Prints TAP.
# BIN: where the programs are. KILLS=n: how many times daemon or a worker is killed at a random moment (default 6; 1000 for the long run).
set -u
KILLS=${KILLS:-6} CAMERAS=${CAMERAS:-5} SEED=${SEED:-1}
. tests/chain_setup.sh
rigsim="$rigsim --cameras $CAMERAS --seed $SEED"
{
    rig_section
    cat <<E
[settings]
iso = 100
shutter = 1/125
E
    $rigsim --list
} >"$D/rigd.conf"
start_cameras
# Every frame of every take here once: as many files as cameras, each unlike every other, none half; the manifest agrees.
accounts() {
    bad=0
    for t in "$D"/takes/*/; do
        state=$(sed -n 's/.*"state":"\([a-z]*\)","id".*/\1/p' "$t/take.json")
        case $state in
        verified)
            [ "$(ls "$t/raw" | wc -l)" = "$CAMERAS" ] || { echo "$t: $(ls "$t/raw")"; bad=1; }
            "$BIN/rigctl" export "$(basename "$t")" || { echo "$t: its manifest does not verify"; bad=1; } ;;
        failed) # only a take whose shutters were never pressed may fail here
            grep -q 'never pressed\|not fit\|cancelled' "$t/take.json" || { echo "$t: $(sed 's/"cameras".*//' "$t/take.json")"; bad=1; }
            [ "$(ls "$t/raw" | wc -l)" = 0 ] || { echo "$t failed, with frames"; bad=1; } ;;
        *) echo "$t is $state"; bad=1 ;;
        esac
    done
    find "$D/takes" -name '*.part' | grep . && bad=1
    double=$(cat "$D"/takes/*/raw/* 2>/dev/null | wc -c)
    [ "$double" -gt 0 ] || { echo "no frames at all"; bad=1; }
    find "$D/takes" -path '*/raw/*' -type f -exec sha256sum {} + | cut -d' ' -f1 | sort | uniq -d | grep . && { echo "a frame is there twice"; bad=1; }
    return $bad
}
start
must "all cameras open" ready
check "preflight finds them fit" "$BIN/rigctl" preflight
check "a take from request to verified" "$BIN/rigctl" capture --name first
check "it says how far apart the shutters opened" sh -c "$BIN/rigctl report \$(ls $D/takes) | grep 'shutters: spread'"
check "a second rigd on the same socket is refused" sh -c "! $BIN/rigd --config $D/rigd.conf --socket $D/s"
check "a camera that nobody knows is refused" sh -c "! $BIN/rigctl identify Z99"
check "a trigger without a light says so" sh -c "$BIN/rigctl identify board 2>&1 | grep 'has no light'"
check "doctor looks at this machine" sh -c "$BIN/rigctl doctor; [ \$? -le 1 ]"
check "metrics are Prometheus text" sh -c "$BIN/rigctl metrics | grep -q '^rigd_takes_verified_total 1'"
k=0
while [ $k -lt "$KILLS" ]; do
    "$BIN/rigctl" capture --name "kill$k" >/dev/null 2>&1 &
    ctl=$!
    # somewhere in a take of about a second: a number from seed and round
    sleep "$(awk -v s="$SEED" -v k="$k" 'BEGIN { srand(s * 100003 + k); printf "%.3f", rand() * 1.6 }')"
    victim=$rigd
    if [ $((k % 3)) = 2 ]; then
        victim=$(pgrep -P "$rigd" -f 'rigd-camera' | head -n $((k % CAMERAS + 1)) | tail -1)
    fi
    [ -n "$victim" ] && kill -9 "$victim" 2>/dev/null
    if [ "$victim" = "$rigd" ]; then
        wait "$rigd" 2>/dev/null
        start
    fi
    wait $ctl
    ready >/dev/null || break
    k=$((k + 1))
done
check "$KILLS kills of daemon or worker: it is ready again" test $k = "$KILLS"
check "no frame is lost, doubled or half there" accounts
# Not before: with delays a kill may fall between the shutters of two bodies, and a take of which some were pressed and some never.
check "lag is measured" "$BIN/rigctl" calibrate lag --shots 3
gone() { ! is_running "$rigd"; }
kill "$rigd"
check "it ends when asked to" within 600 gone
# Ours are known by the socket in their environment: a test beside this one kills its daemon, too, and has a camera A01. Who was killed
# with its daemon may take a moment to be gone.
no_worker() {
    for p in $(pgrep -f '^rigd-camera A'); do
        tr '\0' '\n' <"/proc/$p/environ" 2>/dev/null | grep -qxF "RIGD_SOCKET=$D/s" && { ps -fp "$p"; return 1; }
    done
    return 0
}
check "no worker is left" within 600 no_worker
echo "1..$n"
exit $failed
