#!/bin/sh
# tests/test_rig_chain.sh - the whole rig as a user runs it: rigsim's cameras and wires, rigd with its workers, rigctl. Prints TAP.
# BIN: where the programs are. KILLS=n: how many times daemon or a worker is killed at a random moment (default 6; 1000 for the long run).
set -u
BIN=${BIN:-build/bin} KILLS=${KILLS:-6} CAMERAS=${CAMERAS:-5} SEED=${SEED:-1}
D=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-test-XXXXXX") || exit 1
n=0 failed=0 rigd='' sim=''
export RIGD_SOCKET="$D/s"
finish() {
    [ -n "$rigd" ] && kill "$rigd" 2>/dev/null && wait "$rigd" 2>/dev/null
    [ -n "$sim" ] && kill "$sim" 2>/dev/null && wait "$sim" 2>/dev/null
    rm -rf "$D"
}
trap finish EXIT
check() { # name, command...
    n=$((n + 1)) name=$1
    shift
    if "$@" >"$D/out" 2>&1; then
        echo "ok $n - $name"
    else
        failed=1
        echo "not ok $n - $name"
        sed 's/^/#   /' "$D/out" | tail -20
        tail -10 "$D/rigd.log" 2>/dev/null | sed 's/^/#   /'
    fi
}
port=$((10000 + $$ % 1100 * 20))
cat >"$D/rigd.conf" <<E
[rig]
takes = $D/takes
state = $D/state
socket = $D/s
personality_dir = $PWD/config/cameras
raw_mb = 2
free_space_mb = 1
collect_timeout_ms = 3000
[settings]
iso = 100
shutter = 1/125
E
simulate="$BIN/rigsim --cameras $CAMERAS --personality nikon --port $port --seed $SEED --raw-size 408x272 --trigger-socket $D/t"
$simulate --list >>"$D/rigd.conf"
$simulate >"$D/sim.log" 2>&1 &
sim=$!
while [ ! -S "$D/t" ]; do kill -0 $sim || { echo "1..0 # rigsim did not start: $(tail -1 "$D/sim.log")"; exit 1; }; sleep .1; done
start() {
    "$BIN/rigd" --config "$D/rigd.conf" >>"$D/rigd.log" 2>&1 &
    rigd=$!
}
ready() { # all cameras ready and nothing under way, within a minute
    i=0
    while [ $i -lt 600 ]; do
        "$BIN/rigctl" --json status >"$D/status" 2>/dev/null && grep -q "\"n_ready\":$CAMERAS," "$D/status" && grep -q '"busy":false' "$D/status" &&
            ! "$BIN/rigctl" takes 2>/dev/null | grep -qE ' (armed|exposing|collecting) ' && return 0
        sleep .1
        i=$((i + 1))
    done
    cat "$D/status"
    return 1
}
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
check "all cameras open" ready
check "preflight finds them fit" "$BIN/rigctl" preflight
check "a take from request to verified" "$BIN/rigctl" capture --name first
check "it says how far apart the shutters opened" sh -c "$BIN/rigctl report \$(ls $D/takes) | grep 'shutters: spread'"
check "a second rigd on the same socket is refused" sh -c "! $BIN/rigd --config $D/rigd.conf --socket $D/s"
check "lag is measured" "$BIN/rigctl" calibrate lag --shots 3
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
check "it ends when asked to" sh -c "kill $rigd; for i in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30; do kill -0 $rigd 2>/dev/null || exit 0; sleep .1; done; [ \"\$(cut -d' ' -f3 /proc/$rigd/stat)\" = Z ]"
check "no worker is left" sh -c "! pgrep -f '^rigd-camera A0[1-$CAMERAS]\$' -P 1"
echo "1..$n"
exit $failed
