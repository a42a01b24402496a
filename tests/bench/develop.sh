#!/bin/sh
# tests/bench/develop.sh - developing: seconds and megabytes per 24-megapixel frame and core, then a rig of FRAMES (85) bodies, sustained.
# DISTINCT (6) raws are made and given FRAMES names; pictures are removed round by round, so that 3 GB of disk are enough.
# A peer, where it is there: dcraw.
set -eu
: "${BIN:=build/bin}" "${RAWS:=build/tests/bench/raws}" "${FRAMES:=85}" "${SIZE:=6000x4000}" "${DISTINCT:=6}" "${MODES:=half bilinear ahd}"
cores=$(nproc) round=17
work=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-bench-XXXXXX")
trap 'rm -rf "$work"' EXIT
trap 'exit 1' INT TERM
mkdir "$work/made" "$work/raw"
"$RAWS" "$DISTINCT" "$SIZE" "$work/made"
i=0
while [ "$i" -lt "$FRAMES" ]; do
    ln -s "$work/made/A0$((i % DISTINCT + 1)).dng" "$work/raw/$(printf 'A%03d' "$i").dng"
    i=$((i + 1))
done
width=${SIZE%x*} height=${SIZE#*x}
echo "frame: $SIZE; two frames of 16-bit RGB are $((width * height * 12 / 1000000)) MB; $cores cores, load $(cut -d ' ' -f 1 /proc/loadavg)"
figure() { sed -n "s/.*\"$1\": *\([0-9.]*\).*/\1/p" "$work/said"; }
for mode in $MODES; do
    "$BIN/rigd-develop" "--$mode" "$work/made/A01.dng" "$work/one.exr" >"$work/said"
    echo "one frame, --$mode: $(printf %.2f "$(figure total)") s wall, $(printf %.2f "$(figure cpu_s)") s of one core, peak $(awk "BEGIN { printf \"%.0f\", $(figure peak_rss_bytes) / 1e6 }") MB, $(awk "BEGIN { printf \"%.1f\", $(figure bytes) / 1e6 }") MB of EXR"
done
if command -v dcraw >/dev/null; then
    for q in 0 3; do
        start=$(date +%s.%N)
        dcraw -c -4 -o 0 -r 1 1 1 1 -q $q "$work/made/A01.dng" >/dev/null
        echo "one frame, dcraw -q $q: $(awk "BEGIN { printf \"%.2f\", $(date +%s.%N) - $start }") s wall"
    done
fi
for mode in $MODES; do
    done_frames=0 seconds=0 peak=0
    while [ "$done_frames" -lt "$FRAMES" ]; do
        set --
        k=$done_frames
        while [ "$k" -lt "$FRAMES" ] && [ "$k" -lt $((done_frames + round)) ]; do
            set -- "$@" "$work/raw/$(printf 'A%03d' "$k").dng"
            k=$((k + 1))
        done
        "$BIN/rigctl" develop --json "--$mode" -o "$work/out" "$@" 2>"$work/errors" >"$work/said" || { cat "$work/errors"; exit 1; }
        set -- "$(sed 's/.*"n_failed": *[0-9]*, *"seconds": *\([0-9.]*\), *"peak_rss_bytes": *\([0-9.]*\).*/\1 \2/' "$work/said")"
        seconds=$(awk "BEGIN { print $seconds + ${1% *} }")
        peak=$(awk "BEGIN { print (${1#* } > $peak ? ${1#* } : $peak) }")
        rm -r "$work/out"
        done_frames=$k
    done
    awk "BEGIN { printf \"%d frames, --$mode, $cores at once: %.1f s, %.2f frames/s, at most %.0f MB per worker (load now %s)\\n\", $FRAMES, $seconds, $FRAMES / $seconds, $peak / 1e6, \"$(cut -d ' ' -f 1 /proc/loadavg)\" }"
done
