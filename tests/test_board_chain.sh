#!/bin/sh
# tests/test_board_chain.sh - the whole chain: a hand presses the button of the trigger board (the real firmware in simavr), rigd hears it over
# the real libusb, prepares the cameras and loads the shot, the board's edges press rigsim's shutters, their flash-sync contacts close the
# board's inputs. Prints TAP. BIN, BOARDSIM: where the programs are.
set -u
CAMERAS=${CAMERAS:-5}
. tests/chain_setup.sh
BOARDSIM=${BOARDSIM:-${BIN%/bin}/tests/board/boardsim}
[ -x "$BOARDSIM" ] || { echo "1..0 # SKIP $BOARDSIM is not built"; exit 0; }
rigsim="$rigsim --cameras $CAMERAS --seed 3 --set lag_ms=60 --set lag_spread_ms=12 --set lag_jitter_ms=0.05"
# full-press on the outputs of the first register, half-press on the second, relays on the third
{
    rig_section
    cat <<E
[settings]
iso = 100
shutter = 1/125
[trigger]
kind = usb
output_registers = 3
half_press_ms = 100
hold_ms = 100
max_hold_ms = 1000
E
    $rigsim --list | awk '/^\[camera/ { in_camera = 1; i = n++ } !in_camera { next }
        /^full_line/ { print "full_line = " i; next } /^half_line/ { print "half_line = " 8 + i; next }
        /^relay_line/ { print "relay_line = " 16 + i; next } { print }'
} >"$D/rigd.conf"
start_cameras
"$BOARDSIM" --config "$D/rigd.conf" --wires "$D/t" "$BIN/rigd" --config "$D/rigd.conf" >"$D/rigd.log" 2>&1 &
rigd=$! # in the end, boardsim is what has to end
status() { "$BIN/rigctl" --json status >"$D/status" 2>/dev/null && grep -q "$1" "$D/status"; }
idle() { status "\"n_ready\":$CAMERAS," && grep -q '"busy":false' "$D/status" && grep -q '"trigger":"usb"' "$D/status"; }
board_ready() { ready && within 900 idle || { cat "$D/status"; return 1; }; }
verified() { [ "$(cat "$D"/takes/*/take.json 2>/dev/null | grep -c '"state":"verified"')" = "$1" ]; }
press() { # and the take that follows: the how-manieth
    kill -USR1 $rigd
    within 900 verified "$1"
}
spread_us() { # of the latest take
    "$BIN/rigctl" --json report "$(ls "$D/takes" | tail -1)" | tr ',{}' '\n\n\n' | sed -n 's/.*"spread_ms":\([0-9.]*\).*/\1/p' | awk '{ print int(1000 * $1) }'
}
must "rigd finds the board and the cameras" board_ready
check "a press of the button becomes a verified take" press 1
check "it has a frame of each camera" sh -c "[ \$(ls $D/takes/*/raw | wc -l) = $CAMERAS ]"
check "the take says how far apart the shutters opened" sh -c "$BIN/rigctl report \$(ls $D/takes) | grep 'shutters: spread'"
before=$(spread_us)
check "lag is measured through the board's inputs" "$BIN/rigctl" calibrate lag --shots 4
check "ready again" board_ready
check "asked which board it is, it takes the order" "$BIN/rigctl" identify board
check "a second press becomes a take with the lags made up for" press 2
after=$(spread_us)
echo "# spread ${before:-?} us before calibration, ${after:-?} us after"
# What the board adds: half of what it needs between edges, some 200 us, and a sample of its inputs, 125 us; the bodies .05 ms each.
check "then the shutters open together" test "${after:-99999}" -lt 600 -a "${before:-0}" -gt 5000
check "no command, edge or stamp was out of order" sh -c "! grep -E 'error|warning: (trigger|boardsim)' $D/rigd.log"
kill -USR2 $rigd
check "the cable falls out: rigd says that the trigger is gone" within 600 status '"trigger":"\(broken\|not there\)"'
check "plugged in again it is found again" board_ready
check "and the button works again" press 3
check "ready a third time" board_ready
check "it says what a press would do" status '"button":"takes"'
"$BIN/rigctl" capture --on-button --name armed >"$D/armed" 2>&1 &
armed=$!
check "armed, it says that the next press fires" within 600 status '"state":"armed".*"button":"fires"'
check "a take from here is refused, and why is said" sh -c "! $BIN/rigctl capture 2>&1 | grep -q verified; $BIN/rigctl status | grep 'armed: the trigger'"
check "the board fires, and its frames are fetched" press 4
check "who armed it has the answer" wait $armed
check "ready a fourth time" board_ready
"$BIN/rigctl" capture --on-button --name cancelled >"$D/armed" 2>&1 &
armed=$!
check "armed once more" within 600 status '"button":"fires"'
check "cancelled, it is disarmed at once" sh -c "$BIN/rigctl cancel"
refused() { ! wait $armed; }
check "who armed it hears no" refused
why_not() { grep -q 'the button was not pressed' "$D/armed" "$D"/takes/*cancelled/take.json; }
check "with no frame, and a reason" within 600 why_not
ended() { ! is_running $rigd; }
kill $rigd
check "rigd ends when asked to" within 600 ended
echo "1..$n"
exit $failed
