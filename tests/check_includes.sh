#!/bin/sh
# tests/check_includes.sh - who may include whom (firmware <- rigd -> solver/take <- solver <- tests), and each foreign library in
# one .c file only. Prints TAP; run from the repository root.
set -u
n=0 failed=0
report() { # name, offending lines
    n=$((n + 1))
    if [ -z "$2" ]; then
        echo "ok $n - $1"
    else
        failed=1
        echo "not ok $n - $1"
        printf '%s\n' "$2" | sed 's/^/#   /'
    fi
}

# Quoted includes of the sources in $1 (skipping $2) whose path does not begin with one of the folders in $3.
strays() {
    [ -d "$1" ] || return 0
    grep -rn '^ *# *include *"' "$1" --include='*.[ch]' --include='*.cc' | grep -v "^${2:-//}" |
        grep -vE "#[ ]*include \"($3)/"
}
report "includes are written from the root, in allowed directions: solver/take" "$(strays solver/take '' solver/take)"
report "solver includes solver only" "$(strays solver solver/take/ solver)"
report "rigd includes rigd, firmware and solver/take only" "$(strays rigd '' 'rigd|firmware|solver/take')"
report "firmware includes firmware only" "$(strays firmware '' firmware)"
report "tests include from the root" "$(strays tests '' 'solver|rigd|firmware|tests')"

only_in() { # library, pattern of its headers, the one file
    report "$1 is included in $3 only" "$(grep -rnE "^ *# *include *<($2)" solver rigd firmware --include='*.[ch]' 2>/dev/null | grep -v "^$3:")"
}
only_in OpenEXR 'openexr|Imath|Imf' solver/take/image_exr.c
only_in libtiff 'tiff' solver/take/image_tiff.c
only_in libjpeg 'jpeglib|turbojpeg' solver/take/image_jpeg.c
only_in libpng 'png\.h' solver/take/image_png.c
only_in jansson 'jansson' solver/take/json.c
only_in assimp 'assimp' solver/mesh_import.c
only_in expat 'expat' solver/xml.c
only_in Embree 'embree' solver/rays.c
only_in LibRaw 'libraw' rigd/develop.c
only_in libgphoto2 'gphoto2' rigd/camera_gphoto.c
only_in libgpiod 'gpiod' rigd/trigger_gpio.c
only_in inih 'ini\.h' rigd/config.c
only_in xxHash 'xxhash' rigd/digest.c
only_in systemd 'systemd/' rigd/daemon.c
only_in libusb 'libusb' rigd/trigger_usb.c
only_in libmicrohttpd 'microhttpd' rigd/web.c
report "no folder or file is called utils or common" "$(find solver rigd firmware tests config -iname '*utils*' -o -iname 'common*' 2>/dev/null)"
echo "1..$n"
exit $failed
