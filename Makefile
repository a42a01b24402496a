# studiorig - one button in a photogrammetry studio, relightable materials out of it.  `make help` lists the targets.
# Variants by one variable: make VARIANT=debug|asan|tsan (build/<variant>/ instead of build/).
VERSION := 0.1.0
VARIANT ?= release
PREFIX ?= /usr/local
ifeq ($(origin CC),default)
CC := gcc
endif
Q := $(if $(V),,@)
BUILD := build$(if $(filter-out release,$(VARIANT)),/$(VARIANT))
MACHINE := $(shell uname -m)

# ---- packages (Debian 12; the same names in Debian 13) ----------------------------------------------------------------
PACKAGES := gcc make pkg-config libopenexr-dev libembree-dev libassimp-dev libjansson-dev libtiff-dev libpng-dev libjpeg-dev libexpat1-dev liblapacke-dev libopenblas-dev libcmocka-dev perl help2man dcraw gnuplot-nox \
  libgphoto2-dev libgpiod-dev libinih-dev libmicrohttpd-dev libraw-dev libsystemd-dev libumockdev-dev umockdev libusb-1.0-0-dev libxxhash-dev \
  gcc-avr avr-libc libsimavr-dev libelf-dev time
PACKAGES_TEST := chromium gphoto2 libimage-exiftool-perl hugin-tools libsuitesparse-dev
PACKAGES_FUZZ := clang libclang-rt-dev
PACKAGES_BENCH := libceres-dev g++

# ---- flags --------------------------------------------------------------------------------------------------------------
FLAGS_release := -O2 -g
FLAGS_debug := -O0 -g3
FLAGS_asan := -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer
FLAGS_tsan := -O1 -g -fsanitize=thread
CFLAGS_ALL = -std=gnu11 -D_GNU_SOURCE $(FLAGS_$(VARIANT)) -Wall -Wextra -Wshadow -Wstrict-prototypes -fno-math-errno -fno-trapping-math \
  -ffp-contract=off -ffile-prefix-map=$(CURDIR)=. -pthread -I. -I/usr/include/OpenEXR -I/usr/include/Imath \
  -DSTUDIORIG_VERSION='"$(VERSION)"' $(CFLAGS)
EMBREE = $(shell test -e /usr/include/embree4/rtcore.h && echo embree4 || echo embree3)
LIBS = -lOpenEXRCore -l$(EMBREE) -lassimp -ljansson -ltiff -lpng -ljpeg -lexpat -llapacke -lopenblas -lm
ifeq ($(MACHINE),x86_64)
ISA_avx2 := -mavx2 -mfma -ffp-contract=fast
ISA_avx512 := -mavx512f -mavx512dq -mavx512bw -mavx512vl -mfma -mprefer-vector-width=512 -ffp-contract=fast
endif

# ---- what is built: every source of a folder ------------------------------------------------------------------------------
TAKE := $(wildcard solver/take/*.c)
LIBRARY := $(TAKE) $(filter-out solver/main.c,$(wildcard solver/*.c)) $(wildcard solver/kernels/*.c)
COMMANDS := $(wildcard solver/commands/*.c)
RIG_PROGRAMS := rigctl rigd rigd-camera rigd-contact rigd-develop rigd-panorama rigd-unpack
RIG := $(filter-out $(addprefix rigd/,camera_gphoto.c camera_worker.c contact_main.c daemon.c develop.c develop_main.c main.c panorama_main.c rigctl.c rigctl_develop.c unpack.c),$(wildcard rigd/*.c))
RIGSIM := $(wildcard tests/rigsim/*.c)
RIGSIM_LIB := $(filter-out $(addprefix tests/rigsim/,client.c main.c server.c server_faults.c server_head.c server_shutter.c),$(RIGSIM))
LIBS_RIG = -ljansson -lusb-1.0 -linih -lsystemd -lxxhash -lgpiod -lmicrohttpd -lm
LIBS_RAW = -lraw_r -lgomp -lm
LIBS_CAMERA = -lgphoto2 -lgphoto2_port -ljansson -lxxhash -lm
FIRMWARE_LOGIC := $(filter-out firmware/main.c firmware/board_%.c,$(wildcard firmware/*.c))
FIRMWARE_SIM := $(FIRMWARE_LOGIC) firmware/board_sim.c # the same logic on the host
TESTS := $(basename $(notdir $(wildcard tests/test_*.c))) check_kernels
BOARD_TESTS := test_trigger_usb test_board_shots test_board_loss
FUZZERS := $(patsubst fuzz_%,%,$(basename $(notdir $(wildcard tests/fuzz/fuzz_*.c))))
FUZZED := $(LIBRARY) $(RIG) $(RIGSIM_LIB) $(FIRMWARE_SIM) # what a fuzzer calls of these is linked

# ---- rules --------------------------------------------------------------------------------------------------------------
object = $(patsubst %.c,$(BUILD)/obj/%.o,$(1))
ifneq ($(filter firmware test test-vm demo bench bench-chain bench-develop bench-firmware bench-panorama bench-rig bench-studios chart figure5 figures results stability experiments,$(MAKECMDGOALS)),)
FIRST := deps # these install what is missing before the first file is compiled
endif
.PHONY: all firmware deps deps-test deps-fuzz deps-bench test test-vm demo bench bench-chain bench-develop bench-firmware bench-panorama bench-rig bench-studios chart figure5 figures results stability experiments fuzz check-includes man install clean help
.DELETE_ON_ERROR:
.SECONDARY:

all: $(BUILD)/bin/rigsim $(BUILD)/bin/rigsolve $(addprefix $(BUILD)/bin/,$(RIG_PROGRAMS))

$(BUILD)/obj/%.o: %.c Makefile | $(FIRST)
	@mkdir -p $(@D)
	@$(if $(V),,echo '  CC $<')
	$(Q)$(CC) $(CFLAGS_ALL) $(ISA) -MMD -MP -c $< -o $@
$(BUILD)/obj/%.o: %.cc Makefile | $(FIRST)
	@mkdir -p $(@D)
	@$(if $(V),,echo '  CXX $<')
	$(Q)$(CXX) -std=c++17 -O3 -g -march=native -I. -I/usr/include/eigen3 -MMD -MP -c $< -o $@
$(BUILD)/obj/rigd/web.o $(BUILD)/fuzz/obj/rigd/web.o: $(wildcard rigd/web/page.*) # they go into it
$(BUILD)/obj/solver/kernels/kernels_avx2.o: ISA := $(ISA_avx2)
$(BUILD)/obj/solver/kernels/kernels_avx512.o: ISA := $(ISA_avx512)
$(BUILD)/obj/solver/kernels/kernels_%.o: FLAGS_release := -O3 -g
$(BUILD)/libstudiorig.a: $(call object,$(LIBRARY))
	@rm -f $@
	@$(if $(V),,echo '  AR $@')
	$(Q)ar rcsD $@ $^
$(BUILD)/libtake.a: $(call object,$(TAKE))
	@rm -f $@
	@$(if $(V),,echo '  AR $@')
	$(Q)ar rcsD $@ $^
$(BUILD)/librig.a: $(call object,$(RIG))
	@rm -f $@
	@$(if $(V),,echo '  AR $@')
	$(Q)ar rcsD $@ $^
$(BUILD)/bin/rigsolve: $(call object,$(COMMANDS) solver/main.c) $(BUILD)/libstudiorig.a
	@mkdir -p $(@D)
	@$(if $(V),,echo '  LD $@')
	$(Q)$(CC) $(CFLAGS_ALL) $^ $(LIBS) -o $@
link_rig = @mkdir -p $(@D); $(if $(V),,echo '  LD $@';) $(CC) $(CFLAGS_ALL) -Wl,--as-needed $^
$(BUILD)/bin/rigd: $(call object,rigd/main.c rigd/daemon.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) $(LIBS_RIG) -o $@
$(BUILD)/bin/rigctl: $(call object,rigd/rigctl.c rigd/rigctl_develop.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) $(LIBS_RIG) -o $@
$(BUILD)/bin/rigd-camera: $(call object,rigd/camera_gphoto.c rigd/camera_worker.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) $(LIBS_CAMERA) -o $@
$(BUILD)/bin/rigd-contact: $(call object,rigd/contact.c rigd/contact_main.c) $(BUILD)/libtake.a
	$(link_rig) $(LIBS) -o $@
$(BUILD)/bin/rigd-unpack: $(call object,rigd/develop.c rigd/unpack.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) $(LIBS_RAW) -ljansson -o $@
$(BUILD)/bin/rigd-develop: $(call object,rigd/develop.c rigd/develop_main.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) $(LIBS_RAW) -lOpenEXRCore -ltiff -lpng -ljpeg -ljansson -lxxhash -o $@
$(BUILD)/bin/rigd-panorama: $(call object,rigd/develop.c rigd/panorama_main.c) $(BUILD)/librig.a $(BUILD)/libtake.a
	$(link_rig) -lOpenEXRCore -ltiff -lpng -ljpeg -ljansson $(LIBS_RAW) -o $@
$(BUILD)/bin/rigsim: $(call object,$(filter-out %/client.c,$(RIGSIM))) $(BUILD)/librig.a $(BUILD)/libstudiorig.a
	@mkdir -p $(@D)
	@$(if $(V),,echo '  LD $@')
	$(Q)$(CC) $(CFLAGS_ALL) $^ $(LIBS) -o $@
$(BUILD)/librigsim.a: $(call object,$(RIGSIM_LIB) tests/rigsim/client.c $(wildcard tests/usb/*.c) $(filter-out %/boardsim.c,$(wildcard tests/board/*.c)))
	@rm -f $@
	@$(if $(V),,echo '  AR $@')
	$(Q)ar rcsD $@ $^
$(BUILD)/tests/%: $(BUILD)/obj/tests/%.o $(BUILD)/librigsim.a $(BUILD)/librig.a $(BUILD)/libstudiorig.a
	@mkdir -p $(@D)
	@$(if $(V),,echo '  LD $@')
	$(Q)$(CC) $(CFLAGS_ALL) -Wl,--as-needed $^ -lcmocka $(LIBS_RIG) $(LIBS) -o $@
$(BUILD)/tests/test_camera_worker $(BUILD)/tests/test_config $(BUILD)/tests/test_rigsim_wire: | $(BUILD)/bin/rigd-camera $(BUILD)/bin/rigsim
$(BUILD)/tests/test_developing: | $(BUILD)/bin/rigd-develop $(BUILD)/bin/rigctl
$(BUILD)/tests/test_develop: | $(BUILD)/bin/rigd-unpack
$(BUILD)/tests/test_develop: $(call object,rigd/develop.c rigd/resting.c)
$(BUILD)/tests/test_develop: LIBS += $(LIBS_RAW)
$(BUILD)/tests/test_rigd_panorama: | $(BUILD)/bin/rigd-develop $(BUILD)/bin/rigd-panorama
$(BUILD)/tests/bench/stability_joint: $(call object,solver/commands/arguments.c)
$(addprefix $(BUILD)/obj/tests/,test_usb_camera.o $(addsuffix .o,$(BOARD_TESTS)) usb/usb_camera.o usb/usbfs.o board/fake_board.o board/live_board.o board/boardsim.o): CFLAGS_ALL += $(shell pkg-config --cflags umockdev-1.0 2>/dev/null)
$(BUILD)/tests/test_usb_camera $(addprefix $(BUILD)/tests/,$(BOARD_TESTS)) $(BUILD)/tests/board/boardsim: LIBS += $(shell pkg-config --libs umockdev-1.0 2>/dev/null)
$(addprefix $(BUILD)/tests/,$(BOARD_TESTS)) $(BUILD)/tests/board/boardsim: LIBS += -lsimavr -lelf -Wl,--wrap=clock_gettime,--wrap=pthread_cond_timedwait # board_time.h
$(addprefix $(BUILD)/tests/,$(BOARD_TESTS)) $(BUILD)/tests/board/boardsim: | build/firmware/trigger.elf
$(BUILD)/tests/test_usb_camera $(addprefix $(BUILD)/tests/,$(BOARD_TESTS)): | $(BUILD)/bin/rigd $(BUILD)/bin/rigd-camera
$(BUILD)/tests/test_pcg: LIBS += $(if $(wildcard /usr/include/suitesparse/cholmod.h),-lcholmod)
$(BUILD)/tests/test_firmware: $(call object,$(FIRMWARE_SIM))
$(BUILD)/tests/bench/bench_firmware: $(call object,$(FIRMWARE_SIM))
$(BUILD)/tests/test_firmware_avr $(BUILD)/tests/bench/bench_firmware: LIBS += -lsimavr -lelf
$(BUILD)/tests/test_firmware_avr $(BUILD)/tests/bench/bench_firmware: | build/firmware/trigger.elf
$(BUILD)/fuzz/obj/%.o: %.c Makefile | deps-fuzz
	@mkdir -p $(@D)
	@$(if $(V),,echo '  CC (fuzz) $<')
	$(Q)clang $(FUZZ_FLAGS) -MMD -MP -c $< -o $@
$(BUILD)/fuzz/libfuzzed.a: $(patsubst %.c,$(BUILD)/fuzz/obj/%.o,$(FUZZED))
	@rm -f $@
	$(Q)ar rcsD $@ $^
$(BUILD)/fuzz/fuzz_%: $(BUILD)/fuzz/obj/tests/fuzz/fuzz_%.o $(BUILD)/fuzz/libfuzzed.a
	@$(if $(V),,echo '  LD (fuzz) $@')
	$(Q)clang $(FUZZ_FLAGS) -fsanitize=fuzzer -Wl,--as-needed $^ $(LIBS_RIG) $(LIBS) -o $@

# ---- firmware of the trigger board: one image, whatever the variant ------------------------------------------------------------
AVR_FLAGS := -std=gnu11 -mmcu=atmega32u4 -DF_CPU=16000000UL -Os -g -ffunction-sections -fdata-sections -Wall -Wextra -Wshadow -Wstrict-prototypes \
  -fdebug-prefix-map=$(CURDIR)=. -I.
firmware: deps build/firmware/trigger.hex
	@avr-size -C --mcu=atmega32u4 build/firmware/trigger.elf | sed '/^$$/d'
	@echo "firmware: build/firmware/trigger.hex; how to flash it: firmware/README.md"
build/firmware/%.o: firmware/%.c Makefile | $(FIRST)
	@mkdir -p $(@D)
	@$(if $(V),,echo '  AVR-CC $<')
	$(Q)avr-gcc $(AVR_FLAGS) -MMD -MP -c $< -o $@
build/firmware/trigger.elf: $(patsubst firmware/%.c,build/firmware/%.o,$(FIRMWARE_LOGIC) firmware/board_atmega32u4.c firmware/main.c)
	@$(if $(V),,echo '  AVR-LD $@')
	$(Q)avr-gcc $(AVR_FLAGS) -Wl,--gc-sections $^ -o $@
build/firmware/trigger.hex: build/firmware/trigger.elf
	$(Q)avr-objcopy -O ihex -R .eeprom $< $@

# dpkg-query knows what is there; apt-get is asked only for what is not.
install_packages = @missing=$$(for p in $(1); do dpkg-query -W -f='$${Status}\n' $$p 2>/dev/null | grep -q 'ok installed' || echo $$p; done); \
  if [ -n "$$missing" ]; then echo "deps: installing" $$missing; \
    command -v apt-get >/dev/null || { echo "deps: no apt-get here: install the packages named above by hand" >&2; exit 1; }; \
    SUDO=; [ "$$(id -u)" = 0 ] || { command -v sudo >/dev/null && SUDO=sudo || { echo "deps: not root and no sudo: run as root: apt-get install" $$missing >&2; exit 1; }; }; \
    $$SUDO apt-get update -qq && DEBIAN_FRONTEND=noninteractive $$SUDO apt-get install -y -qq --no-install-recommends $$missing >/dev/null || \
      { echo "deps: apt-get failed: run it by hand to see why: apt-get install" $$missing >&2; exit 1; }; echo "deps: done"; fi
deps: ; $(call install_packages,$(PACKAGES))
deps-test: deps ; $(call install_packages,$(PACKAGES_TEST))
deps-fuzz: ; $(call install_packages,$(PACKAGES_FUZZ))
deps-bench: deps ; $(call install_packages,$(PACKAGES_BENCH))

# ---- tests ----------------------------------------------------------------------------------------------------------------
TEST_PROGRAMS := $(addprefix $(BUILD)/tests/,$(TESTS))
TEST_ALONE := tests/test_board_chain.sh # a simulated core that must keep up with the clock: nothing else runs meanwhile
TEST_SCRIPTS := $(filter-out $(TEST_ALONE), $(wildcard tests/check_*.sh tests/test_*.sh))
test: deps-test all $(TEST_PROGRAMS) $(BUILD)/tests/board/boardsim
	@judge() { CMOCKA_MESSAGE_OUTPUT=TAP BIN=$(BUILD)/bin prove --timer --merge --failures --comments --exec '' "$$@" || err=1; }; \
	  err=0; judge -j $(shell nproc) $(TEST_PROGRAMS) $(TEST_SCRIPTS); judge $(TEST_ALONE); exit $$err
test-vm: deps $(BUILD)/tests/vm/test_gpio_vm
	@prove --timer --verbose --exec '' tests/vm/run.sh :: $(BUILD)/vm $(BUILD)/tests/vm/test_gpio_vm
check-includes:
	@prove --exec '' tests/check_includes.sh

FUZZ_SECONDS ?= 60
FUZZ_FLAGS = -std=gnu11 -D_GNU_SOURCE -O1 -g -fsanitize=fuzzer-no-link,address,undefined -fno-sanitize-recover=undefined -pthread -I. \
  -I/usr/include/OpenEXR -I/usr/include/Imath -DSTUDIORIG_VERSION='"$(VERSION)"'
FUZZ_PROGRAMS := $(addprefix $(BUILD)/fuzz/fuzz_,$(FUZZERS))
fuzz: deps deps-fuzz $(FUZZ_PROGRAMS)
	@printf '%s\n' $(FUZZ_PROGRAMS) | xargs -P 2 -I{} sh tests/fuzz/run.sh {} $(FUZZ_SECONDS)

# ---- demonstration, measurements ------------------------------------------------------------------------------------------
# The button is the trigger board's where its simulation can be built.
demo: deps all
	@$(MAKE) --no-print-directory $(BUILD)/tests/board/boardsim || echo 'demo: no boardsim here: the trigger is simulated by rigsim alone'
	@BIN=$(BUILD)/bin sh tests/demo.sh build/demo

HAVE_CERES := $(wildcard /usr/include/ceres/jet.h)
BENCHES := kernels rays synth
BENCH_PROGRAMS := $(addprefix $(BUILD)/tests/bench/bench_,$(BENCHES))
$(BUILD)/tests/bench/bench_kernels: LIBS += $(if $(HAVE_CERES),-lstdc++)
$(BUILD)/tests/bench/bench_kernels: $(if $(HAVE_CERES),$(BUILD)/obj/tests/bench/ceres_peer.o)
bench: deps $(BENCH_PROGRAMS) $(BUILD)/bin/rigsolve
	@for b in $(BENCHES); do echo "== bench_$$b"; $(BUILD)/tests/bench/bench_$$b || exit 1; done
PANORAMAS ?= $(wildcard ../shared/data/hdri/studio_small_03_1k.hdr) build/panorama/synth/panorama.exr
bench-panorama: deps deps-bench $(BUILD)/tests/bench/bench_panorama $(BUILD)/bin/rigd-panorama $(BUILD)/bin/rigsolve
	@BIN=$(BUILD)/bin BENCH=$(BUILD)/tests/bench/bench_panorama sh tests/bench/panorama.sh build/panorama $(PANORAMAS)
bench-firmware: deps $(BUILD)/tests/bench/bench_firmware
	@$(BUILD)/tests/bench/bench_firmware $(FIRMWARE_BENCH)
RIG_BENCHES ?= scale faults soak lag full eio kills
bench-rig: deps all
	@for b in $(RIG_BENCHES); do echo "== $$b"; BIN=$(BUILD)/bin perl tests/bench/rig.pl $$b || failed=1; done; [ -z "$$failed" ]
CHAIN_KILLS ?= 100 20
bench-chain: deps all
	@BIN=$(BUILD)/bin perl tests/bench/chain_kills.pl $(CHAIN_KILLS)
bench-develop: deps all $(BUILD)/tests/bench/raws
	@BIN=$(BUILD)/bin RAWS=$(BUILD)/tests/bench/raws sh tests/bench/develop.sh
STUDIOS ?= $(wildcard ../shared/data/studio-pebble ../shared/data/studio-vase)
bench-studios: deps all $(addprefix $(BUILD)/tests/bench/,judge judge_materials raws)
	@BIN=$(BUILD)/bin TOOLS=$(BUILD)/tests/bench sh tests/bench/studios.sh $(STUDIOS)
experiments: deps $(BUILD)/bin/rigsolve $(BUILD)/tests/bench/judge
	@BIN=$(BUILD)/bin JUDGE=$(BUILD)/tests/bench/judge sh tests/bench/experiments.sh
RESULTS ?=
results: deps deps-bench
	@perl tests/results/measure.pl $(RESULTS)
CHART_TAKES ?= D3 D5 $(wildcard ../shared/data/studio-pebble)
chart: deps $(BUILD)/bin/rigsolve $(BUILD)/tests/bench/chart_lights
	@mkdir -p build/chart && $(BUILD)/tests/bench/chart_lights >build/chart/lights.csv && gnuplot -e "out='build/chart/lights'" tests/bench/chart_lights.gp
	@echo "chart: build/chart/lights.csv .svg .png: seconds against error over N, roughness and kernel"
	@$(BUILD)/bin/rigsolve chart $(CHART_TAKES) $(CHART_OPTIONS) -o build/chart
	@echo "chart: build/chart/chart.csv .svg .png: CPU seconds of a solve against its error: N, texture, method, kernel, presets"
figure5: deps deps-bench $(BUILD)/tests/bench/figure5
	@mkdir -p build/figure5 && $(BUILD)/tests/bench/figure5 build/figure5 >build/figure5/figure5.csv && gnuplot -e "out='build/figure5/figure5'" tests/bench/figure5.gp
	@echo "figure5: build/figure5/figure5.csv .svg .png: the paper's Figure 5: w_sim x start x true lights"
figures: deps deps-bench $(BUILD)/bin/rigsolve
	@BIN=$(BUILD)/bin sh tests/bench/figures_materials.sh
	@echo "figures: build/figures_materials/*.csv, *.svg: the paper's Figures 8 to 11"
STABILITY_OPTIONS ?=
stability: deps deps-bench $(BUILD)/tests/bench/stability_kernels $(BUILD)/tests/bench/stability_joint
	@mkdir -p build/stability && $(BUILD)/tests/bench/stability_kernels >build/stability/kernels.csv && gnuplot -e "out='build/stability/kernels'" tests/bench/stability_kernels.gp
	@echo "stability: build/stability/kernels.csv .svg .png: where float32 fails, over roughness and elevation"
	@$(BUILD)/tests/bench/stability_joint $(STABILITY_OPTIONS) >build/stability/joint.csv && gnuplot -e "out='build/stability/joint'" tests/bench/stability_joint.gp
	@echo "stability: build/stability/joint.csv .svg .png: where the lights are found, where not, and whether the solver says so"

# ---- installation ---------------------------------------------------------------------------------------------------------
MAN := $(addprefix $(BUILD)/man/rigsolve,.1 $(addprefix -,$(addsuffix .1,$(filter-out arguments chart_draw inputs output presets solve_materials solved,$(notdir $(COMMANDS:.c=))))))
RIG_MAN := $(addprefix $(BUILD)/man/,rigctl.1 rigctl-develop.1 rigctl-calibrate-colour.1 rigd-develop.1 rigd.8)
man: $(MAN) $(RIG_MAN)
$(BUILD)/man/rigctl.1: $(BUILD)/bin/rigctl
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'asks and tells the daemon of a photogrammetry rig' -o $@ $<
$(BUILD)/man/rigctl-develop.1: $(BUILD)/bin/rigctl
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'raw files become linear pictures' --version-string=$(VERSION) -o $@ "$< develop"
$(BUILD)/man/rigctl-calibrate-colour.1: $(BUILD)/bin/rigctl
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'one radiometric space for all bodies of a rig' --version-string=$(VERSION) -o $@ "$< calibrate colour"
$(BUILD)/man/rigd-develop.1: $(BUILD)/bin/rigd-develop
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'one raw file becomes one linear picture' -o $@ $<
$(BUILD)/man/rigd.8: $(BUILD)/bin/rigd
	@mkdir -p $(@D)
	$(Q)help2man -N -s 8 -n 'fires the cameras of a photogrammetry studio and keeps every frame' -o $@ $<
$(BUILD)/man/rigsolve.1: $(BUILD)/bin/rigsolve
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'from photographs in a studio to relightable materials' -o $@ $<
$(BUILD)/man/rigsolve-%.1: $(BUILD)/bin/rigsolve
	@mkdir -p $(@D)
	$(Q)help2man -N -n 'rigsolve $*' --version-string=$(VERSION) -o $@ "$< $*"
install: all $(MAN) $(RIG_MAN)
	install -D -m 755 -t $(DESTDIR)$(PREFIX)/bin $(addprefix $(BUILD)/bin/,rigsolve $(RIG_PROGRAMS))
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/man/man1 $(MAN)
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/man/man1 $(filter %.1,$(RIG_MAN))
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/man/man8 $(BUILD)/man/rigd.8
	install -D -m 644 config/blender/import_studiorig.py $(DESTDIR)$(PREFIX)/share/studiorig/blender/import_studiorig.py
	install -D -m 644 config/completion/rigsolve.bash $(DESTDIR)$(PREFIX)/share/bash-completion/completions/rigsolve
	install -D -m 644 config/completion/rigctl.bash $(DESTDIR)$(PREFIX)/share/bash-completion/completions/rigctl
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/studiorig/config config/*.conf
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/studiorig/config/cameras config/cameras/*.conf
	install -D -m 755 -t $(DESTDIR)$(PREFIX)/share/studiorig/config/reconstruct config/reconstruct/*
	install -D -m 644 config/systemd/rigd.service $(DESTDIR)$(PREFIX)/lib/systemd/system/rigd.service
	sed -i 's|/usr/local/bin|$(PREFIX)/bin|' $(DESTDIR)$(PREFIX)/lib/systemd/system/rigd.service
	install -D -m 644 config/systemd/71-rigd.rules $(DESTDIR)$(PREFIX)/lib/udev/rules.d/71-rigd.rules
	install -D -m 644 config/systemd/rigd.sysusers $(DESTDIR)$(PREFIX)/lib/sysusers.d/rigd.conf
	install -D -m 644 config/systemd/rigd.tmpfiles $(DESTDIR)$(PREFIX)/lib/tmpfiles.d/rigd.conf
	install -D -m 644 -t $(DESTDIR)$(PREFIX)/share/doc/studiorig README.md LICENSE solver/NOTATION.md rigd/CONTROL.md
clean:
	rm -rf build
help:
	@echo 'make            the programs, in build/bin/       make test      everything that must hold (installs packages)'
	@echo 'make demo       one button, end to end             make fuzz      libFuzzer on every parser (FUZZ_SECONDS=60)'
	@echo 'make firmware   the image of the trigger board    make bench-firmware  its latencies, edges, a long fuzz'
	@echo 'make test-vm    GPIO on a simulated chip, in a virtual machine'
	@echo 'make bench      seconds and errors of kernels     make chart     speed against accuracy      make stability  where it fails'
	@echo 'make bench-panorama  what a merged panorama loses of the one that was photographed, and what 24 megapixels take'
	@echo 'make bench-rig  the rig with simulated cameras: kills, faults, scale, soak, lag, disks (half an hour; RIG_BENCHES="lag soak")'
	@echo 'make bench-chain  kill -9 of any process from the cameras to the solve, then every byte is looked at (CHAIN_KILLS="100 20": in 20 rounds)'
	@echo 'make bench-studios  what the whole chain loses of studios whose answer is known, stage by stage (STUDIOS="FOLDER...")'
	@echo 'make results    what was promised and what is measured: tests/results/README.md (RESULTS=all; RESULTS="S4 lag")'
	@echo 'make bench-develop  raws to radiance: seconds and MB per 24-megapixel frame, 85 of them sustained'
	@echo 'make install    DESTDIR= PREFIX=/usr/local        make deps      Debian packages             make clean'
	@echo 'variants: VARIANT=debug|asan|tsan; V=1 shows commands'
-include $(shell find $(BUILD)/obj $(BUILD)/fuzz build/firmware -name '*.d' 2>/dev/null)
