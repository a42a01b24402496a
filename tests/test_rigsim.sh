#!/bin/sh
# tests/test_rigsim.sh - the real gphoto2 lists, configures, captures and downloads from every personality; what it downloads is what
# dcraw, exiftool and the camera say it is. BIN: folder of rigsim. Prints TAP; skips without gphoto2.
set -u
export LC_ALL=C TZ=UTC
BIN=${BIN:-build/bin}
command -v gphoto2 >/dev/null || { echo "1..0 # SKIP gphoto2 is not installed"; exit 0; }
case $BIN in /*) ;; *) BIN=$PWD/$BIN ;; esac
work=$(mktemp -d "${TMPDIR:-/tmp}/studiorig-test-XXXXXX") || exit 1
pid=
trap '[ -n "$pid" ] && kill $pid 2>/dev/null; rm -rf "$work"' EXIT
n=0 failed=0
check() { # name, then a command that must succeed
    name=$1 n=$((n + 1))
    shift
    if "$@" >"$work/out" 2>&1; then
        echo "ok $n - $name"
    else
        failed=1
        echo "not ok $n - $name"
        sed 's/^/#   /' "$work/out" | head -20
    fi
}

address=127.$((1 + ($$ >> 16 & 127))).$(($$ >> 8 & 255)).$(($$ & 255)) # nobody else's on this machine (tests/loopback.h)
start() { # options
    "$BIN/rigsim" --cameras 2 --address $address --raw-size 640x480 "$@" 2>"$work/log" &
    pid=$!
    for wait in $(seq 1200); do
        grep -q 'cameras (' "$work/log" && return
        kill -0 $pid 2>/dev/null || break
        sleep .05
    done
    echo "not ok $((n + 1)) - rigsim starts"
    sed 's/^/#   /' "$work/log"
    echo "1..$((n + 1))"
    exit 1
}
stop() {
    kill $pid && wait $pid
    status=$?
    pid=
    return $status
}
g() { (cd "$work/files" && HOME="$work/home" timeout 300 gphoto2 --port ptpip:$address:15740:15741 "$@" 2>&1); }
says() { # text, gphoto2's options
    text=$1
    shift
    g "$@" | tee "$work/out" | grep -qF -- "$text"
}
eventually() { # the second file is late
    for try in $(seq 100); do
        "$@" && return
        sleep .1
    done
    return 1
}
fresh() {
    rm -rf "$work/home" "$work/files"
    mkdir "$work/home" "$work/files"
}
only_file() { # the one file of that ending
    set -- "$work"/files/*."$1"
    [ $# = 1 ] && [ -s "$1" ] && echo "$1"
}
whole() { [ -n "$(only_file "$1")" ] && [ "$(wc -c <"$(only_file "$1")")" -gt 614400 ]; }

story() { # personality, model, key of the aperture, its value, key and value of raw + JPEG, folder, first serial, camera clips
    personality=$1 model=$2 aperture=$3 value=$4 format=$5 both=$6 folder=$7 serial=$8
    fresh
    start --personality "$personality" --clock fixed --seed 3
    check "$personality: --summary tells model and serial" says "Model: $model" --summary
    check "$personality: its serial is that of --list" says "Serial Number: $serial" --summary
    check "$personality: --list-config has iso" says /main/imgsettings/iso --list-config
    check "$personality: iso is 100 at first" says "Current: 100" --get-config iso
    check "$personality: iso can be set" g --set-config iso=400
    check "$personality: and is 400 to the next client" says "Current: 400" --get-config iso
    check "$personality: $aperture can be set" g --set-config "$aperture=$value"
    g --set-config iso=123456 >/dev/null
    check "$personality: a wrong iso changes nothing" says "Current: 400" --get-config iso
    check "$personality: capture to the card and download" says "Saving file as" --set-config capturetarget=1 --capture-image-and-download --keep
    raw=$(only_file DNG)
    check "$personality: one whole raw came" whole DNG
    first=$(sha256sum <"$raw")
    mv "$raw" "$work/first.dng"
    check "$personality: --list-files shows it" says .DNG --list-files
    check "$personality: --get-thumbnail" says "Saving file as thumb_" --get-thumbnail 1
    check "$personality: which is a JPEG" sh -c "od -An -tx1 -N3 $work/files/thumb_* | grep -q 'ff d8 ff'"
    rm -f "$work"/files/*
    check "$personality: --get-file gives" says "Saving file as" --get-file 1
    check "$personality: the same bytes again" [ "$(sha256sum <"$(only_file DNG)")" = "$first" ]
    if command -v dcraw >/dev/null; then
        dcraw -i -v "$work/first.dng" >"$work/dcraw"
        check "$personality: dcraw reads ISO, true time and pattern" sh -c "grep -q 'ISO speed: 400' $work/dcraw &&
            grep -q 'Shutter: 1/128.0' $work/dcraw && grep -q 'RG/GB' $work/dcraw && grep -q '640 x 480' $work/dcraw"
        check "$personality: and develops it" sh -c "dcraw -4 -T -c $work/first.dng | wc -c | grep -qv '^0$'"
    fi
    if command -v exiftool >/dev/null; then
        check "$personality: exiftool reads serial, aperture and sub-seconds" sh -c "exiftool -s3 -SerialNumber -FNumber -SubSecDateTimeOriginal \
            $work/first.dng | tr '\n' ' ' | grep -q '^$serial ${value#f/}.* 2026:01:01 00:00:10.000000 '"
    fi
    g --delete-all-files --folder "$folder" >/dev/null
    check "$personality: RAW+JPEG gives two files" g --set-config "$format=$both" --set-config capturetarget=1 --capture-image
    check "$personality: both on the card" eventually says "There are 2 files in folder '$folder'" --list-files
    check "$personality: and both can be had" g --get-all-files
    check "$personality: the JPEG is one" sh -c "od -An -tx1 -N3 $work/files/*.JPG | grep -q 'ff d8 ff'"
    check "$personality: --delete-file" g --delete-file 1 --folder "$folder"
    check "$personality: leaves the other" says "There is 1 file in folder '$folder'" --list-files
    g --set-config "$format=$both" >/dev/null
    fresh # the client's own default: to the camera's memory
    check "$personality: capture with the client's defaults" says "Saving file as" --capture-image-and-download
    check "$personality: $personality's server ends cleanly" stop
    start --personality "$personality" --clock fixed --seed 3
    fresh
    g --set-config iso=400 --set-config "$aperture=$value" --set-config capturetarget=1 --capture-image-and-download >/dev/null
    check "$personality: the same seed gives the same raw in another life" [ "$(sha256sum <"$(only_file DNG)")" = "$first" ]
    stop
}

story generic 'Simulated camera' f-number f/5.6 imagequality 'Unknown value 0007' /store_00010001/DCIM/100SIM 10001
story nikon D500 f-number f/5.6 imagequality NEF+Fine /store_00020001/DCIM/100ND500 6001001
story canon 'Canon EOS 700D' aperture 5.6 imageformat 'RAW + Large Fine JPEG' /store_00020001/DCIM/100CANON 053070001001

check "a wrong option is a usage error" sh -c "$BIN/rigsim --cameras 0 2>&1; [ \$? = 2 ]"
check "another address is listed" sh -c "$BIN/rigsim --address 127.3.2.1 --list | grep -qx 'port = ptpip:127.3.2.1:15740:15741'"
check "one that others could reach is refused" sh -c "$BIN/rigsim --address 0.0.0.0 2>&1 | grep -q \"found '0.0.0.0'; expected 127.x.y.z\""
check "--list is a section per camera" sh -c "$BIN/rigsim --cameras 23 --list | grep -c '^\[camera \"[AB][0-9][0-9]\"\]' | grep -qx 23"
check "a wrong personality names file and line" sh -c "printf 'base = nikon\nwhat = 1\n' >$work/p; $BIN/rigsim --personality $work/p 2>&1 | grep -q \"$work/p:2: found 'what'\""
echo "1..$n"
exit $failed
