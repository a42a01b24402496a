#!/bin/sh
# tests/test_rigctl.sh - what rigctl says while it waits for the daemon. Prints TAP.
# The daemon is a few lines of Perl that say what they are told and are silent where they are told. Run from the repository root; BIN is where rigctl lies.
set -u
. tests/commands_setup.sh
rigctl=${BIN:-build/bin}/rigctl
# A line is said to who has subscribed, "sleep S" is silence, "until TEXT" is silence until rigctl has said that; then the answer.
daemon() {
    rm -f "$dir/s"
    : >"$dir/log"
    exec 3<&0 # what runs beside the shell has no standard input
    perl -MIO::Socket::UNIX -MTime::HiRes=sleep -e '($s, $log) = @ARGV; $l = IO::Socket::UNIX->new(Local => "$s.new", Listen => 1) or die; rename "$s.new", $s; alarm 300; $c = $l->accept;
        sub says { open(my $f, "<", $log) or return; grep { index($_, $_[0]) >= 0 } <$f> }
        while (defined($_ = <$c>)) { $told |= /"do":"subscribe"/; last if /"id":1[,}]/ }
        while (<STDIN>) { if (/^sleep (.*)/) { sleep $1 } elsif (/^until (.*)/) { my $text = $1; for (1 .. 1200) { last if says($text); sleep .05 } } elsif ($told) { $c->print($_); $c->flush } }
        $c->print("{\"v\":1,\"id\":1,\"ok\":true,\"result\":{\"id\":\"t\",\"state\":\"verified\",\"steps\":[],\"lag\":[]}}\n"); 1 while <$c>' "$dir/s" "$dir/log" <&3 &
    served=$!
    exec 3<&-
    tries=0
    until [ -S "$dir/s" ] || [ $tries = 600 ]; do tries=$((tries + 1)); sleep .1; done
}
# says NAME PATTERN COMMAND...: rigctl, in a pipe, ends well, and a line of what it said meanwhile is like that
says() {
    name=$1 pattern=$2
    shift 2
    "$rigctl" --socket "$dir/s" "$@" 2>&1 >/dev/null </dev/null | cat >"$dir/log"
    wait "$served"
    grep -qE "$pattern" "$dir/log"
    result $? "$name"
}

daemon <<'E1'
{"v":1,"event":"panorama","body":{"step":"turn","stop":2,"n_stops":4,"yaw_deg":120,"pitch_deg":-20}}
until to yaw 120, pitch -20: for
{"v":1,"event":"prompt","body":{"on":true,"text":"look after the head"}}
sleep 2.2
E1
says "a head that turns for long is said to" '^  stop 2 of 4: to yaw 120, pitch -20: for [0-9]+ s$' panorama
[ "$(tail -n 1 "$dir/log")" = '  ==> look after the head' ]
result $? "who is asked for something is asked once"

daemon <<'E2'
{"v":1,"event":"processing","body":{"take":"t","step":{"step":"standard","state":"running","n":1,"n_done":0}}}
{"v":1,"event":"progress","body":{"take":"t","step":"standard","stage":"materials","done":6,"total":8}}
sleep .1
{"v":1,"event":"progress","body":{"take":"t","step":"standard","stage":"materials","done":8,"total":8}}
until standard: after materials
E2
says "what a step said last is told though it is silent now, and not as if it went on" '^  standard: after materials$' process t --watch

daemon <<'E3'
{"v":1,"event":"say","body":{"severity":"info","text":"lag: shot 1 of 5"}}
until calibrate: for
E3
says "a calibration says its shots, in a pipe too" '^  info: lag: shot 1 of 5$' calibrate lag
grep -qE '^  calibrate: for [0-9]+ s$' "$dir/log"
result $? "and that it goes on"

daemon <<'E4'
{"v":1,"event":"say","body":{"severity":"info","text":"lag: shot 1 of 5"}}
E4
"$rigctl" --json --socket "$dir/s" calibrate lag >"$dir/log" 2>&1 </dev/null
wait "$served"
[ "$(cat "$dir/log")" = '{"id":"t","state":"verified","steps":[],"lag":[]}' ]
result $? "JSON is the answer and nothing else"
echo "1..$n"
exit $failed
