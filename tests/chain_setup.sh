# tests/chain_setup.sh - sourced by the tests of the whole chain: a folder of their own, checks as TAP, rigsim's cameras and a rigd.
#
# $D is removed in the end. The cameras listen on a loopback address that belongs to this process (tests/loopback.h): tests that run at the
# same time cannot meet. What cannot come any more is not waited for: the logs of rigsim and rigd are shown, and that is the end.
BIN=$(cd "${BIN:-build/bin}" && pwd) || exit 1
D=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-test-XXXXXX") || exit 1
n=0 failed=0 rigd='' sim='' seen_sim=0 seen_rigd=0
export RIGD_SOCKET="$D/s"
rigsim="$BIN/rigsim --address 127.$((1 + ($$ >> 16 & 127))).$(($$ >> 8 & 255)).$(($$ & 255)) --personality nikon --raw-size 408x272 --trigger-socket $D/t"
finish() {
    [ -n "$rigd" ] && kill "$rigd" 2>/dev/null && wait "$rigd" 2>/dev/null
    [ -n "$sim" ] && kill "$sim" 2>/dev/null && wait "$sim" 2>/dev/null
    rm -rf "$D"
}
trap finish EXIT
logs() { # what both said since the last time
    for log in sim rigd; do
        [ -f "$D/$log.log" ] || continue
        eval "seen=\$seen_$log"
        tail -n +$((seen + 1)) "$D/$log.log" | tail -n 20 | sed "s/^/# $log.log: /"
        eval "seen_$log=$(wc -l <"$D/$log.log")"
    done
}
check() { # name, command...
    n=$((n + 1)) name=$1
    shift
    if "$@" >"$D/out" 2>&1; then
        echo "ok $n - $name"
        return 0
    fi
    failed=1
    echo "not ok $n - $name"
    tail -25 "$D/out" | sed 's/^/#   /'
    logs
    return 1
}
must() { # the same; without it nothing that follows can hold
    check "$@" && return
    echo "1..$n"
    exit 1
}
is_running() { case $(cut -d' ' -f3 "/proc/$1/stat" 2>/dev/null) in '' | Z) return 1 ;; esac; } # nobody here may reap orphans
# Patience is for machines that are too busy: what fails, fails late; what holds costs nothing.
within() { # tenths of a second, command...
    tenths=$1
    shift
    until "$@" >/dev/null 2>&1; do
        tenths=$((tenths - 1))
        [ $tenths -gt 0 ] || { echo "never: $*"; return 1; }
        sleep .1
    done
}
rig_section() {
    cat <<E1
[rig]
takes = $D/takes
state = $D/state
socket = $D/s
personality_dir = $PWD/config/cameras
raw_mb = 1
free_space_mb = 1
collect_timeout_ms = 3000
E1
}
start_cameras() { # options of rigsim
    rm -f "$D/t"
    $rigsim "$@" >>"$D/sim.log" 2>&1 &
    sim=$!
    sim_is_up() { [ -S "$D/t" ] || ! is_running $sim; }
    within 600 sim_is_up && [ -S "$D/t" ] && return
    echo "not ok $((n + 1)) - rigsim starts"
    logs
    echo "1..$((n + 1))"
    exit 1
}
start() {
    "$BIN/rigd" --config "$D/rigd.conf" >>"$D/rigd.log" 2>&1 &
    rigd=$!
}
start_again() { # as after a power cut, for processes
    kill -9 "$rigd"
    wait "$rigd" 2>/dev/null
    start
}
is_idle() { # all cameras ready and nothing under way
    "$BIN/rigctl" --json status >"$D/status" 2>/dev/null && grep -q "\"n_ready\":$CAMERAS," "$D/status" && grep -q '"busy":false' "$D/status" &&
        ! "$BIN/rigctl" takes 2>/dev/null | grep -qE ' (armed|exposing|collecting) '
}
ready() { # within three minutes: a camera that fell silent is tried again every minute
    idle_or_gone() { is_idle || ! is_running "$rigd"; }
    within 1800 idle_or_gone && is_running "$rigd" && return
    cat "$D/status"
    return 1
}
