#!/bin/sh
# tests/test_chain_kills.sh - the real chain, from the cameras to the solve, with up to three kills -9 on the way: nothing is lost, doubled or half there,
# and what comes out is what comes out undisturbed. tests/bench/chain_kills.pl is the long run, and says what is looked at. Prints TAP.
out=$(STOPS=0,0 TARGETS='several,rigd-develop,rigd while solving' VERBOSE=1 perl tests/bench/chain_kills.pl 3 1 2>&1)
status=$?
[ $status = 0 ] && echo 'ok 1 - processes are killed at up to three stages: the take is solved as if nothing had been' || echo 'not ok 1 - processes are killed: something is not as it should be'
[ $status = 0 ] || echo "$out" | sed 's/^/# /'
case $out in *"
"[1-9]" kills in"*) echo 'ok 2 - they were indeed killed, one at least: a program may be done before its turn comes' ;; *) echo 'not ok 2 - they were not killed' && echo "$out" | sed 's/^/# /' && status=1 ;; esac
echo 1..2
exit $status
