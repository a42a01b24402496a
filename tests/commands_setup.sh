# tests/commands_setup.sh - sourced by the tests of rigsolve's commands: a folder of their own, $dir, removed in the end, and checks as TAP. What a
# command said is in $dir/log, and shown where a check fails. BIN is where rigsolve lies.
rigsolve=${BIN:-build/bin}/rigsolve
dir=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-test-XXXXXX") || exit 1
trap 'rm -rf "$dir"' EXIT
n=0 failed=0
result() { # status, name
    n=$((n + 1))
    if [ "$1" = 0 ]; then
        echo "ok $n - $2"
    else
        failed=1
        echo "not ok $n - $2"
        sed 's/^/#   /' "$dir/log" | tail -n 15
    fi
}
# gives CODE NAME COMMAND...: the command ends with that exit code
gives() {
    code=$1 name=$2
    shift 2
    "$@" >"$dir/log" 2>&1 </dev/null
    got=$?
    [ "$got" = "$code" ] || echo "exit code $got, expected $code: $*" >>"$dir/log"
    [ "$got" = "$code" ]
    result $? "$name"
}
