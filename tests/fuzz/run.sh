#!/bin/sh
# tests/fuzz/run.sh PROGRAM SECONDS - one libFuzzer run from the committed seeds; quiet unless something is found.
name=$(basename "$1") seeds=$(dirname "$0")/seeds/$(basename "$1" | sed s/^fuzz_//)
corpus=$(mktemp -d) || exit 1
trap 'rm -rf "$corpus"' EXIT
[ -d "$seeds" ] && cp "$seeds"/* "$corpus"/
if "$1" -max_total_time="$2" -timeout=10 -rss_limit_mb=3000 -artifact_prefix="build/fuzz/$name-" -print_final_stats=1 "$corpus" >"$corpus.log" 2>&1; then
    echo "ok $name: $(sed -n 's/^stat::number_of_executed_units: *//p' "$corpus.log") inputs in $2 s, $(grep -c . "$corpus.log") log lines, nothing found"
    rm -f "$corpus.log"
else
    tail -40 "$corpus.log"
    echo "not ok $name: see build/fuzz/$name-*"
    rm -f "$corpus.log"
    exit 1
fi
