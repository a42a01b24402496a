# studiorig - one button in a photogrammetry studio, relightable materials out of it.  `make help` lists the targets.
# Variants by one variable: make VARIANT=debug|asan|tsan (build/<variant>/ instead of build/).
VERSION := 0.1.0
VARIANT ?= release
PREFIX ?= /usr/local
CC ?= gcc
BUILD := build$(if $(filter-out release,$(VARIANT)),/$(VARIANT))
MACHINE := $(shell uname -m)

# ---- packages (Debian 12; the same names in Debian 13) ----------------------------------------------------------------
PACKAGES := gcc make pkg-config libopenexr-dev libembree-dev libassimp-dev libjansson-dev libtiff-dev libpng-dev libcmocka-dev perl
PACKAGES_FUZZ := clang libclang-rt-dev
PACKAGES_BENCH := libceres-dev g++ gnuplot-nox

# ---- flags --------------------------------------------------------------------------------------------------------------
FLAGS_release := -O2 -g
FLAGS_debug := -O0 -g3
FLAGS_asan := -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer
FLAGS_tsan := -O1 -g -fsanitize=thread
FLAGS_fuzz := -O1 -g -fsanitize=fuzzer-no-link,address,undefined -fno-sanitize-recover=undefined
CFLAGS_ALL = -std=gnu11 -D_GNU_SOURCE $(FLAGS_$(VARIANT)) -Wall -Wextra -Wshadow -Wstrict-prototypes -fno-math-errno -fno-trapping-math \
  -ffp-contract=off -ffile-prefix-map=$(CURDIR)=. -pthread -I. -I/usr/include/OpenEXR -I/usr/include/Imath \
  -DSTUDIORIG_VERSION='"$(VERSION)"' $(CFLAGS)
EMBREE = $(shell test -e /usr/include/embree4/rtcore.h && echo embree4 || echo embree3)
LIBS = -lOpenEXRCore -l$(EMBREE) -lassimp -ljansson -ltiff -lpng -lm
ifeq ($(MACHINE),x86_64)
ISA_avx2 := -mavx2 -mfma
ISA_avx512 := -mavx512f -mavx512dq -mavx512bw -mavx512vl -mfma -mprefer-vector-width=512
endif

# ---- what is built ------------------------------------------------------------------------------------------------------
TAKE := $(addprefix solver/take/,atomic_file.c image.c image_exr.c image_hdr.c image_png.c image_tiff.c json.c log.c progress.c take.c)
SOLVER := $(addprefix solver/,cameras.c cameras_colmap.c compare.c disney.c lights.c mesh.c mesh_import.c panorama.c parallel.c \
  rays.c render.c shapes.c synth.c texels.c visibility.c)
KERNELS := $(addprefix solver/kernels/,kernels.c kernels_ref.c kernels_portable.c kernels_avx2.c kernels_avx512.c)
COMMANDS := $(addprefix solver/commands/,brdf.c compare.c lights.c render.c synth.c visibility.c)
LIBRARY := $(TAKE) $(SOLVER) $(KERNELS)
TESTS := $(addprefix test_,cameras compare disney image json lights mesh panorama parallel rays render shapes synth take texels vec3 visibility) check_kernels
FUZZERS := cameras csv exr hdr json lights mesh

# ---- rules --------------------------------------------------------------------------------------------------------------
have = $(wildcard $(1)) # files not written yet are left out
LIBRARY_O := $(patsubst %.c,$(BUILD)/obj/%.o,$(call have,$(LIBRARY)))
COMMANDS_O := $(patsubst %.c,$(BUILD)/obj/%.o,$(call have,$(COMMANDS)) solver/main.c)
ifneq ($(filter test demo bench chart stability fuzz,$(MAKECMDGOALS)),)
FIRST := deps
endif

all: $(BUILD)/bin/rigsolve
.PHONY: all deps test demo bench chart stability fuzz check-includes install clean help man
.DELETE_ON_ERROR:
.SECONDARY:

$(BUILD)/obj/%.o: %.c Makefile | $(FIRST)
	@mkdir -p $(@D)
	$(CC) $(CFLAGS_ALL) $(ISA) -MMD -MP -c $< -o $@
$(BUILD)/obj/solver/kernels/kernels_avx2.o: ISA := $(ISA_avx2)
$(BUILD)/obj/solver/kernels/kernels_avx512.o: ISA := $(ISA_avx512)
$(BUILD)/obj/solver/kernels/kernels_portable.o $(BUILD)/obj/solver/kernels/kernels_avx2.o $(BUILD)/obj/solver/kernels/kernels_avx512.o: \
  FLAGS_release := -O3 -g
$(BUILD)/libstudiorig.a: $(LIBRARY_O)
	@rm -f $@
	ar rcsD $@ $^
$(BUILD)/bin/rigsolve: $(COMMANDS_O) $(BUILD)/libstudiorig.a
	@mkdir -p $(@D)
	$(CC) $(CFLAGS_ALL) $^ $(LIBS) -o $@
$(BUILD)/tests/%: $(BUILD)/obj/tests/%.o $(BUILD)/libstudiorig.a
	@mkdir -p $(@D)
	$(CC) $(CFLAGS_ALL) $^ -lcmocka $(LIBS) -o $@

clean:
	rm -rf build
-include $(shell find $(BUILD)/obj -name '*.d' 2>/dev/null)
