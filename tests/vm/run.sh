#!/bin/sh
# tests/vm/run.sh - the GPIO trigger on the kernel's own simulated chip, with libgpiod as it is installed, in a virtual machine.
#
# Prints TAP. Debian's kernel package without the module gpio-sim is booted by qemu (software emulation: no /dev/kvm needed) on an
# initial file system that holds busybox, the module, the test and its libraries. The module is built from Debian's kernel source with
# two changes: a call that is not exported to modules is replaced, and the parameter "keep" makes a chip that keeps its level when a
# line is freed, as Raspberry Pi's and expanders do. Needs apt (about 240 MB once, kept in $1) and root or sudo to install qemu and
# the kernel's headers. Whatever is missing skips the test.
#   run.sh FOLDER TEST_PROGRAM
set -u
folder=$1 program=$2 here=$(dirname "$0")
skip() {
    echo "1..0 # SKIP $1"
    exit 0
}
[ "$(dpkg --print-architecture 2>/dev/null)" = amd64 ] || skip "this is written for Debian on amd64"
SUDO=
[ "$(id -u)" = 0 ] || { command -v sudo >/dev/null && SUDO=sudo; }
image=$(apt-cache depends linux-image-amd64 2>/dev/null | sed -n 's/.*Depends: \(linux-image-[0-9].*\)/\1/p' | head -n 1)
[ -n "$image" ] || skip "apt knows no linux-image-amd64: run apt-get update"
release=${image#linux-image-}
series=$(echo "$release" | cut -d. -f1,2)
headers=linux-headers-$release

missing=
for p in qemu-system-x86 busybox-static cpio xz-utils "$headers"; do
    dpkg-query -W -f='${Status}\n' "$p" 2>/dev/null | grep -q 'ok installed' || missing="$missing $p"
done
if [ -n "$missing" ]; then
    [ "$(id -u)" = 0 ] || [ -n "$SUDO" ] || skip "not root and no sudo to install$missing"
    echo "# installing$missing"
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive $SUDO apt-get install -y -qq --no-install-recommends $missing >/dev/null 2>&1 || skip "apt-get cannot install$missing"
fi

mkdir -p "$folder/module"
kernel=$folder/vmlinux-$release
modules=$folder/image/lib/modules/$release/kernel
if [ ! -s "$kernel" ] || [ ! -s "$folder/module/$release.ko" ]; then
    echo "# fetching and unpacking $image and the source of the module"
    (cd "$folder" && apt-get download -qq "$image" "linux-source-$series" >/dev/null 2>&1) || skip "apt-get cannot download $image and linux-source-$series"
    rm -rf "$folder/image" "$folder/source"
    mkdir -p "$folder/source"
    dpkg-deb -x "$folder/$image"_*.deb "$folder/image" || skip "$image cannot be unpacked"
    s=linux-source-$series
    dpkg-deb --fsys-tarfile "$folder/$s"_*.deb | tar -xO "./usr/src/$s.tar.xz" | xz -dc | tar -x -C "$folder/source" --strip-components=1 \
        "$s/drivers/gpio/gpio-sim.c" "$s/drivers/gpio/gpiolib.h" "$s/kernel/irq/irq_sim.c" "$s/scripts/extract-vmlinux" || skip "$s is laid out differently"
    cp "$here/Kbuild" "$folder/source/drivers/gpio/gpiolib.h" "$folder/module/"
    sed 's/handle_simple_irq(irq_to_desc(irqnum))/generic_handle_irq(irqnum)/' "$folder/source/kernel/irq/irq_sim.c" >"$folder/module/irq_sim.c"
    sed -e 's/gc->free = gpio_sim_free;/if (!keep) &/' -e '/^#include "gpiolib.h"/a static bool keep;\nmodule_param(keep, bool, 0644);' \
        "$folder/source/drivers/gpio/gpio-sim.c" >"$folder/module/gpio-sim.c"
    if ! make -s -C "/usr/src/$headers" M="$(realpath "$folder/module")" modules >"$folder/module.log" 2>&1; then
        sed 's/^/# /' "$folder/module.log"
        skip "the module gpio-sim does not build against $headers"
    fi
    mv "$folder/module/gpio-simulated.ko" "$folder/module/$release.ko"
    sh "$folder/source/scripts/extract-vmlinux" "$folder/image/boot/vmlinuz-$release" >"$kernel" || skip "the kernel cannot be decompressed"
    rm -rf "$folder"/*.deb "$folder/source"
fi

# The initial file system.
rm -rf "$folder/root"
mkdir -p "$folder/root/bin" "$folder/root/proc" "$folder/root/sys" "$folder/root/dev" "$folder/root/lib/modules"
install -m 755 "$here/init" "$folder/root/init"
install -m 755 /bin/busybox "$folder/root/bin/"
install -m 755 "$program" "$folder/root/bin/test_gpio_vm"
cp "$folder/module/$release.ko" "$folder/root/lib/modules/gpio-simulated.ko"
if [ -e "$modules/fs/configfs/configfs.ko" ]; then
    cp "$modules/fs/configfs/configfs.ko" "$folder/root/lib/modules/configfs.ko"
else
    xz -dc "$modules/fs/configfs/configfs.ko.xz" >"$folder/root/lib/modules/configfs.ko" || skip "no module configfs in $image"
fi
for l in $(ldd "$program" | grep -oE '/[^ ]+'); do
    mkdir -p "$folder/root$(dirname "$l")"
    cp -L "$l" "$folder/root$l"
done
(cd "$folder/root" && find . | cpio -o -H newc --quiet | gzip -1) >"$folder/initrd.gz"

echo "# Linux $release in qemu, $(dpkg-query -W -f='${Package} ${Version}\n' libgpiod2 libgpiod3 2>/dev/null | head -n 1)"
timeout 150 qemu-system-x86_64 -M pc -accel tcg -smp 2 -m 256 -kernel "$kernel" -initrd "$folder/initrd.gz" \
    -append "console=ttyS0 quiet loglevel=1 panic=-1" -display none -vga none -nic none -no-reboot -serial stdio -monitor none \
    </dev/null 2>&1 | tr -d '\r' | sed 's/^\x1b\[K/# /' >"$folder/console.log"
sed -n '/^1\.\./,/^guest: exit/p' "$folder/console.log" | grep -v '^guest:'
if ! grep -q '^guest: exit 0$' "$folder/console.log"; then
    echo "# the machine said at the end:"
    tail -n 15 "$folder/console.log" | sed 's/^/#   /'
    exit 1
fi
