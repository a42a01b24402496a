#!/bin/sh
# tests/test_results.sh - tests/results/measure.pl: a figure comes from what a command printed; one that fails leaves the old row and says so;
# a figure of a note is marked as one; a target's bound decides.
set -u
measure=$(pwd)/tests/results/measure.pl
D=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-test-XXXXXX")
trap 'rm -rf "$D"' EXIT
n=0 failed=0
check() { # what, command...
    n=$((n + 1)) what=$1
    shift
    if "$@" >"$D/said" 2>&1; then echo "ok $n - $what"; else failed=1; echo "not ok $n - $what"; sed 's/^/# /' "$D/said"; fi
}
perl "$measure" no-such-target >/dev/null 2>"$D/refused"
check "an unknown target is refused, and the known ones are named" grep -q 'no-such-target: expected all, a target (S1 S2' "$D/refused"

mkdir -p "$D/tests/results"
cd "$D" || exit 1
cat >tests/results/targets.txt <<'END'
run prints
command: cat printed; exit $(cat status)
cost: 1
proof: /^end/

target A
of: Things
what: the worst of them
bound: <= 2
unit: cm
run: prints
parse: max /^error ([\d.]+)/
why: it is hard

target B
what: counted
bound: = 2
run: prints
parse: count /^error/
partly: only two of many

target C
what: long ago
bound: >= 5
earlier: 7 | in May | abc1234 | by hand | it rained
END
printf 'error 1.5\nerror 1.75\nend\n' >printed
echo 0 >status
row() { grep "^$1," tests/results/figures.csv; }
run() { perl "$measure" "$@" >said 2>&1 || { cat said; return 1; }; }
check "it runs" run
check "the worst figure is found, and within its bound" sh -c "grep '^A,the worst of them: <= 2 cm,1.75,cm,yes,cat printed' tests/results/figures.csv"
check "what is met in part says so, with the reason" sh -c "grep '^B,counted: = 2,2,,partly,.*only two of many' tests/results/figures.csv"
check "a note's figure is marked as not repeated" sh -c "grep '^C,long ago: >= 5,7,,yes,by hand,abc1234,in May,.*not repeated; it rained' tests/results/figures.csv"
check "the page counts them" grep -q '^\*\*2 met, 1 met in part, 0 missed, 0 not measured\*\*, of 3: 2 by runs that figures.csv records, 1 by notes' tests/results/README.md
echo 'error 3' >>printed
check "it runs again" run A
check "beyond its bound it is missed, with the reason on the page" sh -c "grep '^A,.*,3,cm,no,' tests/results/figures.csv && grep 'A.* the worst of them (3 cm, wanted <= 2)\. It is hard\.' tests/results/README.md"
echo 1 >status
check "it runs a third time" run prints
check "a command that fails leaves the old row and says so" sh -c "grep '^A,.*,3,cm,no,.*measurement failed .*exit status 1' tests/results/figures.csv && grep -q '^## Failed' tests/results/README.md"
echo 0 >status
echo 'error 9' >printed
check "it runs a fourth time" run prints
check "so does one that broke off on the way" sh -c "grep '^A,.*,3,cm,no,.*measurement failed .*no such figure' tests/results/figures.csv"
printf 'error 1\nend\n' >printed
check "it runs a fifth time" run prints
check "one that succeeds takes the failure away" sh -c "grep '^A,.*,1,cm,yes,' tests/results/figures.csv && ! grep -q 'measurement failed' tests/results/figures.csv"
echo "1..$n"
exit $failed
