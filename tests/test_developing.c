// tests/test_developing.c - rigd-develop and rigctl develop as programs: equal to dcraw, true to the light that a simulated sensor saw, honest
// about what is wrong, whole after any kill.
#include "rigd/colour.h"
#include "solver/take/image.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "tests/raw_files.h"
#include "tests/rigsim/frame.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>

static const char *bin_folder(void)
{
    return getenv("BIN") ? getenv("BIN") : "build/bin";
}

static void drop(const char *name)
{
    unlink(scratch_path(name));
}

// Runs a command of a shell in which $BIN and $D (the scratch folder) are set; its standard output is parsed into *answer if wanted.
static __attribute__((format(printf, 2, 3))) int run(struct json **answer, const char *format, ...)
{
    char command[4096], *text = NULL;
    size_t n = 0;
    va_list args;
    va_start(args, format);
    vsnprintf(command, sizeof(command), format, args);
    va_end(args);
    setenv("BIN", bin_folder(), 1);
    setenv("D", scratch_dir, 1);
    FILE *p = popen(command, "r"), *m = open_memstream(&text, &n);
    assert_non_null(p);
    assert_non_null(m);
    for (int c; (c = fgetc(p)) != EOF;)
        fputc(c, m);
    fclose(m);
    const int status = pclose(p);
    if (answer)
        assert_int_equal(json_parse(answer, text, n, "what it said"), 0);
    free(text);
    assert_true(WIFEXITED(status));
    return WEXITSTATUS(status);
}

static double number(const struct json *v, const char *path)
{
    double n = NAN;
    json_get_number(v, path, &n);
    return n;
}

static const char *text(const struct json *v, const char *path)
{
    const char *s = "";
    json_get_string(v, path, &s);
    return s;
}

// ---- dcraw -----------------------------------------------------------------------------------------------------------------------

static bool have_dcraw(void)
{
    if (!system("command -v dcraw >/dev/null 2>&1"))
        return true;
    fprintf(stderr, "dcraw is not installed: not compared\n");
    return false;
}

// Of the raw $D/NAME.EXTENSION.
static void assert_dcraws_pixels(const char *name, const char *extension)
{
    struct image ours, theirs;
    char command[300], picture[40];
    snprintf(command, sizeof(command), "$BIN/rigd-develop --half --tiff $D/%s.%s $D/ours.exr >/dev/null", name, extension);
    const int code = run(NULL, command);
    assert_true(code == 0 || code == 3); // 3: one that does not say its exposure
    snprintf(command, sizeof(command), "cd $D && dcraw -4 -o 0 -r 1 1 1 1 -t 0 -T -q 0 %s.%s", name, extension);
    assert_int_equal(run(NULL, command), 0);
    snprintf(picture, sizeof(picture), "%.30s.tiff", name);
    assert_int_equal(image_read(&ours, scratch_path("ours.tif")), 0);
    assert_int_equal(image_read(&theirs, scratch_path(picture)), 0);
    assert_int_equal(ours.width, theirs.width);
    assert_int_equal(ours.height, theirs.height);
    assert_int_equal(ours.n_channels, 3);
    assert_memory_equal(ours.data, theirs.data, (size_t)ours.width * (size_t)ours.height * 3 * sizeof(float));
    image_free(&ours);
    image_free(&theirs);
}

static void tiff_is_dcraws_bit_for_bit(void **state)
{
    (void)state;
    static const uint8_t orders[4][4] = { { 0, 1, 1, 2 }, { 1, 0, 2, 1 }, { 2, 1, 1, 0 }, { 1, 2, 0, 1 } };
    static const int sizes[4][2] = { { 192, 128 }, { 193, 127 }, { 64, 301 }, { 25, 22 } };
    if (!have_dcraw())
        return;
    for (int k = 0; k < 16; k++) {
        struct raw_dng_info info = raw_info(sizes[k / 4][0], sizes[k / 4][1]);
        uint32_t seed = 100u + (uint32_t)k;
        memcpy(info.cfa, orders[k % 4], 4);
        info.black_level = k % 3 ? 1008 : 0;
        info.white_level = k % 5 ? 16383 : 15892;
        for (int i = 0; i < 4 && k % 2; i++)
            info.black_more[i] = (k + 5 * i) % 17;
        raw_write(scratch_path("a.dng"), &info, raw_scatter, &seed);
        assert_dcraws_pixels("a", "dng");
    }
    scratch_empty();
}

// STUDIORIG_RAWS: a folder of raws of real cameras.
static void so_is_that_of_raws_of_real_cameras(void **state)
{
    (void)state;
    const char *folder = getenv("STUDIORIG_RAWS");
    struct dirent **file = NULL;
    int n_compared = 0;
    if (!folder || !have_dcraw())
        return;
    const int n = scandir(folder, &file, NULL, alphasort);
    assert_true(n >= 0);
    for (int i = 0; i < n; i++) {
        char path[PATH_MAX], whole[PATH_MAX];
        snprintf(path, sizeof(path), "%s/%s", folder, file[i]->d_name);
        if (file[i]->d_name[0] != '.' && realpath(path, whole)) {
            fprintf(stderr, "# %s\n", file[i]->d_name);
            assert_int_equal(symlink(whole, scratch_path("real.raw")), 0);
            assert_dcraws_pixels("real", "raw");
            scratch_empty();
            n_compared++;
        }
        free(file[i]);
    }
    free(file);
    assert_true(n_compared > 0);
}

// ---- light -----------------------------------------------------------------------------------------------------------------------

enum { W = 512, H = 384, BLOCK = 32 };

// Smooth, all colours, .05 to .9 of white at the reference exposure.
static double scene_value(double x, double y, int c)
{
    return .3 + .2 * sin(.012 * x + c) * cos(.015 * y) + .1 * c;
}

static const char *any_name(unsigned camera)
{
    (void)camera;
    return "any";
}

static void write_scene(void)
{
    struct image im;
    assert_int_equal(mkdir(scratch_path("scene"), 0777), 0);
    assert_int_equal(image_new(&im, W, H, 3, NULL), 0);
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++)
            for (int c = 0; c < 3; c++)
                im.data[(y * W + x) * 3 + c] = (float)scene_value(x + .5, y + .5, c);
    assert_int_equal(image_write_exr(&im, scratch_path("scene/any.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
}

// A frame of the simulated rig: shot and read noise, black level, the body's own gains.
static void write_frame(const char *name, struct scene *scene, const char *personality, double gain_spread, unsigned camera, double time_s, double f_number, int iso)
{
    static struct personality p;
    struct body b;
    struct frame *f;
    const struct exposure e = { .shot = 1, .utc_ns = 1700000000000000000, .time_s = time_s, .f_number = f_number, .iso = iso };
    assert_int_equal(personality_load(&p, personality), 0);
    p.gain_spread = gain_spread;
    assert_int_equal(body_init(&b, &p, camera, 5, 0, 0), 0);
    assert_int_equal(frame_open(&f, scene, &b, &e, FILES_RAW), 0);
    const uint64_t n = frame_size(f);
    uint8_t *bytes = malloc(n);
    assert_non_null(bytes);
    frame_read(f, 0, bytes, n);
    scratch_write(name, bytes, n);
    free(bytes);
    frame_close(f);
    body_free(&b);
}

// The largest relative difference between means over blocks: 1,024 pixels, so that noise plays no part.
static double worst_block(const struct image *im, double scale)
{
    double worst = 0;
    for (int by = BLOCK; by + 2 * BLOCK <= im->height; by += BLOCK)
        for (int bx = BLOCK; bx + 2 * BLOCK <= im->width; bx += BLOCK)
            for (int c = 0; c < 3; c++) {
                double sum = 0, expected = 0;
                for (int y = by; y < by + BLOCK; y++)
                    for (int x = bx; x < bx + BLOCK; x++) {
                        const double k = (double)W / im->width;
                        sum += (double)im->data[(y * im->width + x) * im->n_channels + c];
                        expected += scene_value((x + .5) * k, (y + .5) * k, c);
                    }
                worst = fmax(worst, fabs(scale * sum / expected - 1));
            }
    return worst;
}

static double median_error(const struct image *im)
{
    int n = 0, under = 0; // under 1 %?
    for (int y = 2; y < im->height - 2; y++)
        for (int x = 2; x < im->width - 2; x++)
            for (int c = 0; c < 3; c++, n++)
                under += fabs((double)im->data[(y * im->width + x) * im->n_channels + c] / scene_value((x + .5) * W / im->width, (y + .5) * W / im->width, c) - 1) < .01;
    return (double)under / n;
}

static void radiance_is_what_the_sensor_saw_whatever_body_exposure_and_demosaicing(void **state)
{
    (void)state;
    static const char *const modes[] = { "--half", "--bilinear", "--ahd" };
    static const struct {
        const char *personality;
        double time_s, f_number;
        int iso;
    } shots[] = { { "generic", 1. / 128, 8, 100 }, { "generic", 1. / 512, 8, 400 }, { "generic", 1. / 64, 11, 100 }, { "nikon", 1. / 128, 8, 100 }, { "canon", 1. / 256, 5.6, 100 } };
    struct scene *scene;
    write_scene();
    assert_int_equal(scene_open(&scene, scratch_path("scene"), W, H, 1, any_name), 0);
    for (int k = 0; k < 5; k++)
        for (int m = 0; m < 3; m++) {
            struct image im;
            struct json *o;
            write_frame("a.dng", scene, shots[k].personality, 0, 0, shots[k].time_s, shots[k].f_number, shots[k].iso);
            assert_int_equal(run(&o, "$BIN/rigd-develop %s $D/a.dng $D/a.exr", modes[m]), 0);
            assert_int_equal(image_read(&im, scratch_path("a.exr")), 0);
            assert_true(worst_block(&im, 1) < .01);
            if (k == 0)
                assert_true(median_error(&im) > .5); // of single pixels, noise and all
            assert_true(image_channel(&im, "clip") == 3);
            json_free(o);
            image_free(&im);
            drop("a.dng");
            drop("a.exr");
        }
    // Radiance 1 can be put elsewhere: eight times the light of the default.
    struct image im;
    write_frame("a.dng", scene, "generic", 0, 0, 1. / 128, 8, 100);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --half --reference-exposure 1/64,4,100 $D/a.dng $D/a.exr >/dev/null"), 0);
    assert_int_equal(image_read(&im, scratch_path("a.exr")), 0);
    assert_true(worst_block(&im, 1. / 8) < .01);
    image_free(&im);
    drop("a.dng");
    drop("a.exr");
    drop("scene/any.exr");
    rmdir(scratch_path("scene"));
    scene_close(scene);
}

static uint16_t spots(void *arg, int x, int y) // one saturated site in each 16 x 16, walking through the cell; noise elsewhere
{
    (void)arg;
    if (x % 16 == 7 + (x / 16) % 2 && y % 16 == 7 + (y / 16) % 2)
        return 16383;
    return (uint16_t)(5000 + raw_scatter(NULL, x, y) % 2000);
}

static void what_is_saturated_is_marked_and_counted(void **state)
{
    (void)state;
    const struct raw_dng_info info = raw_info(160, 128);
    struct json *o;
    struct image im;
    raw_write(scratch_path("a.dng"), &info, spots, NULL);
    assert_int_equal(run(&o, "$BIN/rigd-develop --half $D/a.dng $D/a.exr"), 0);
    assert_true(fabs(number(o, "clipped_share") - 1. / 256) < 1e-12);
    json_free(o);
    assert_int_equal(image_read(&im, scratch_path("a.exr")), 0);
    for (int y = 0; y < im.height; y++)
        for (int x = 0; x < im.width; x++) {
            bool any = false;
            for (int i = 0; i < 4; i++)
                any = any || spots(NULL, 2 * x + i % 2, 2 * y + i / 2) == 16383;
            assert_true(im.data[(y * im.width + x) * 4 + 3] == (any ? 1 : 0));
        }
    image_free(&im);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --ahd $D/a.dng $D/a.exr >/dev/null"), 0);
    assert_int_equal(image_read(&im, scratch_path("a.exr")), 0);
    for (int y = 0; y < im.height; y++)
        for (int x = 0; x < im.width; x++) {
            bool any = false;
            for (int dy = -3; dy <= 3; dy++)
                for (int dx = -3; dx <= 3; dx++)
                    any = any || (x + dx >= 0 && y + dy >= 0 && x + dx < 160 && y + dy < 128 && spots(NULL, x + dx, y + dy) == 16383);
            assert_true(im.data[(y * im.width + x) * 4 + 3] == (any ? 1 : 0));
        }
    image_free(&im);
    scratch_empty();
}

static uint16_t clipped_at_12000(void *arg, int x, int y)
{
    const uint16_t v = raw_scatter(arg, x, y);
    return v > 12000 ? 12000 : v;
}

static void doubts_are_said_and_change_the_exit_status(void **state)
{
    (void)state;
    struct raw_dng_info info = raw_info(96, 64);
    struct json *o;
    raw_write(scratch_path("a.dng"), &info, clipped_at_12000, NULL);
    assert_int_equal(run(&o, "$BIN/rigd-develop --half $D/a.dng $D/a.exr 2>/dev/null"), 0);
    assert_non_null(strstr(text(o, "notes.0"), "pile up from 12000 on"));
    const double found = number(o, "clipped_share");
    assert_true(found > .1);
    json_free(o);
    assert_int_equal(run(&o, "$BIN/rigd-develop --half --saturation 12000 $D/a.dng $D/a.exr 2>/dev/null"), 0);
    assert_true(number(o, "clipped_share") == found);
    json_free(o);
    assert_int_equal(run(&o, "$BIN/rigd-develop --half --saturation 16383 $D/a.dng $D/a.exr 2>/dev/null"), 0);
    assert_true(number(o, "clipped_share") == 0);
    json_free(o);
    info.time_s = 0;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    assert_int_equal(run(&o, "$BIN/rigd-develop --half $D/a.dng $D/a.exr 2>/dev/null"), 3);
    assert_non_null(strstr(text(o, "warnings.0"), "exposure time"));
    json_free(o);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --half --exposure 1/128,0,0 $D/a.dng $D/a.exr >/dev/null 2>&1"), 0);
    scratch_empty();
}

// ---- files -----------------------------------------------------------------------------------------------------------------------

static void the_picture_carries_its_exposure(void **state)
{
    (void)state;
    struct raw_dng_info info = raw_info(96, 64);
    struct json *o;
    char note[4000];
    info.time_s = 1. / 60;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --half --tiff $D/a.dng $D/a.exr >/dev/null"), 0);
    assert_int_equal(image_read_note(scratch_path("a.exr"), "cameraModel", note, sizeof(note)), 0);
    assert_string_equal(note, "Simulated camera");
    assert_int_equal(image_read_note(scratch_path("a.exr"), "cameraSerialNumber", note, sizeof(note)), 0);
    assert_string_equal(note, "10001");
    assert_int_equal(image_read_note(scratch_path("a.exr"), "capDate", note, sizeof(note)), 0);
    assert_string_equal(note, "2023:11:14 22:13:20");
    assert_int_equal(image_read_note(scratch_path("a.exr"), IMAGE_SPREAD_NOTE, note, sizeof(note)), 0);
    assert_string_equal(note, "0");
    assert_int_equal(run(NULL, "$BIN/rigd-develop --ahd $D/a.dng $D/b.exr >/dev/null"), 0);
    assert_int_equal(image_read_note(scratch_path("b.exr"), IMAGE_SPREAD_NOTE, note, sizeof(note)), 0);
    assert_string_equal(note, "3");
    assert_int_equal(image_read_note(scratch_path("a.exr"), "studiorig.develop", note, sizeof(note)), 0);
    assert_int_equal(json_parse(&o, note, strlen(note), "the note"), 0);
    assert_true(number(o, "exposure.0") == 1. / 64);
    assert_true(number(o, "scale") == .5);
    assert_string_equal(text(o, "subseconds"), "123456");
    json_free(o);
    if (!system("command -v exiftool >/dev/null 2>&1")) {
        assert_int_equal(run(&o, "exiftool -j -n -ExposureTime -FNumber -ISO -Model -SerialNumber -SubSecTimeOriginal $D/a.tif | sed '1s/^.//; $s/.$//'"), 0);
        assert_true(fabs(number(o, "ExposureTime") - 1. / 60) < 1e-6);
        assert_true(number(o, "FNumber") == 8);
        assert_true(number(o, "ISO") == 100);
        assert_string_equal(text(o, "Model"), "Simulated camera");
        json_free(o);
    }
    scratch_empty();
}

static void a_second_run_makes_what_has_changed_and_nothing_else(void **state)
{
    (void)state;
    struct raw_dng_info info = raw_info(96, 64);
    struct json *o;
    uint32_t seed = 1;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, &seed);
    raw_write(scratch_path("b.dng"), &info, raw_scatter, &seed);
    static const struct {
        const char *before, *options;
        int n_developed;
    } step[] = {
        { ":", "", 2 },
        { ":", "", 0 },
        { ":", "--half", 2 },
        { ":", "--half", 0 },
        { "rm $D/out/a.exr", "--half", 1 },
        { "head -c 9000 $D/out/a.exr >$D/cut; mv $D/cut $D/out/a.exr", "--half", 1 },
        { "printf x >$D/out/b.exr", "--half", 1 },
        { ":", "--half --tiff", 2 },
        { ":", "--half --tiff", 0 },
        { "rm $D/out/b.tif", "--half --tiff", 1 },
        { ":", "--half --reference-exposure 1/64,8,100", 2 },
        { ":", "--half --reference-exposure 1/64,8,100 --force", 2 },
    };
    for (size_t i = 0; i < sizeof(step) / sizeof(step[0]); i++) {
        assert_int_equal(run(&o, "%s; $BIN/rigctl develop --json %s -o $D/out $D/a.dng $D/b.dng 2>/dev/null", step[i].before, step[i].options), 0);
        assert_int_equal((int)number(o, "n_developed"), step[i].n_developed);
        assert_int_equal((int)number(o, "n_skipped"), 2 - step[i].n_developed);
        json_free(o);
    }
    seed = 2;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, &seed); // another picture under the same name
    assert_int_equal(run(&o, "$BIN/rigctl --json develop --half --reference-exposure 1/64,8,100 -o $D/out $D/a.dng $D/b.dng 2>/dev/null"), 0);
    assert_int_equal((int)number(o, "n_developed"), 1);
    json_free(o);
    assert_int_equal(run(NULL, "rm -r $D/out"), 0);
    scratch_empty();
}

static char *slurp(const char *path, size_t *n)
{
    struct stat st;
    FILE *f = fopen(path, "rb");
    if (!f)
        return NULL;
    assert_int_equal(fstat(fileno(f), &st), 0);
    char *bytes = malloc((size_t)st.st_size + 1);
    assert_non_null(bytes);
    *n = fread(bytes, 1, (size_t)st.st_size, f);
    fclose(f);
    return bytes;
}

// Killed after 0, 1, 2, ... parts of the time that it takes, then once more to the end.
static void a_kill_at_any_time_leaves_whole_files_or_none(void **state)
{
    (void)state;
    enum { POINTS = 40 };
    const struct raw_dng_info info = raw_info(600, 400);
    struct timespec began, ended;
    size_t n_whole, n;
    char raw[600], out[600], tif[600], program[600];
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    double whole_ns = INFINITY;
    for (int k = 0; k < 3; k++) { // the shortest: a machine that stood still would have us kill after the end
        clock_gettime(CLOCK_MONOTONIC, &began);
        assert_int_equal(run(NULL, "$BIN/rigd-develop --tiff $D/a.dng $D/a.exr >/dev/null"), 0);
        clock_gettime(CLOCK_MONOTONIC, &ended);
        whole_ns = fmin(whole_ns, 1e9 * (double)(ended.tv_sec - began.tv_sec) + (double)(ended.tv_nsec - began.tv_nsec));
    }
    char *whole = slurp(scratch_path("a.exr"), &n_whole);
    assert_non_null(whole);
    snprintf(raw, sizeof(raw), "%s/a.dng", scratch_dir);
    snprintf(out, sizeof(out), "%s/a.exr", scratch_dir);
    snprintf(tif, sizeof(tif), "%s/a.tif", scratch_dir);
    snprintf(program, sizeof(program), "%s/rigd-develop", bin_folder());
    int n_killed = 0;
    for (int k = 0; k < POINTS; k++) {
        unlink(out);
        unlink(tif);
        const pid_t pid = fork();
        if (pid == 0) {
            const int null = open("/dev/null", O_WRONLY | O_CLOEXEC);
            dup2(null, 1);
            dup2(null, 2);
            execl(program, program, "--tiff", raw, out, (char *)NULL);
            _exit(127);
        }
        const long ns = (long)(whole_ns * k / POINTS);
        nanosleep(&(struct timespec){ ns / 1000000000, ns % 1000000000 }, NULL);
        kill(pid, SIGKILL);
        int status;
        assert_int_equal(waitpid(pid, &status, 0), pid);
        n_killed += WIFSIGNALED(status);
        char *bytes = slurp(out, &n);
        if (bytes) { // then it is all there
            assert_int_equal(n, n_whole);
            assert_memory_equal(bytes, whole, n);
        }
        free(bytes);
        struct image im;
        if (!access(tif, R_OK)) {
            assert_int_equal(image_read(&im, tif), 0);
            assert_int_equal(im.width, 600);
            image_free(&im);
        }
    }
    assert_true(n_killed > POINTS / 4); // or this test tested nothing
    assert_int_equal(run(NULL, "$BIN/rigd-develop --if-changed --tiff $D/a.dng $D/a.exr >/dev/null"), 0);
    char *bytes = slurp(out, &n);
    assert_int_equal(n, n_whole);
    assert_memory_equal(bytes, whole, n);
    assert_int_equal(run(NULL, "test -z \"$(find $D -name '*.part')\""), 0); // what kills left is swept
    free(bytes);
    free(whole);
    scratch_empty();
}

// The parent dies: its decoders die with it, and what they had finished is not done again.
static void a_killed_run_goes_on_where_it_was(void **state)
{
    (void)state;
    enum { RAWS = 8, KILLS = 6 };
    const struct raw_dng_info info = raw_info(600, 400);
    struct json *o;
    int n_before = 0;
    for (int i = 0; i < RAWS; i++) {
        char name[20];
        uint32_t seed = (uint32_t)i;
        snprintf(name, sizeof(name), "%d.dng", i);
        raw_write(scratch_path(name), &info, raw_scatter, &seed);
    }
    for (int k = 0; k < KILLS; k++) {
        assert_int_equal(run(NULL, "$BIN/rigctl develop --bilinear --jobs 2 -o $D/out $D/?.dng >/dev/null 2>&1 & p=$!; sleep .0%d; kill -9 $p; "
                                   "while for f in /proc/[0-9]*/cmdline; do tr '\\0' ' ' <$f; echo; done 2>/dev/null | grep -q \"[r]igd-develop .*$D/out\"; do sleep .02; done",
                             2 + k),
                         0);
        assert_int_equal(run(&o, "echo \"{\\\"n\\\": $(ls $D/out 2>/dev/null | wc -l)}\""), 0);
        assert_true((int)number(o, "n") >= n_before);
        n_before = (int)number(o, "n");
        json_free(o);
    }
    assert_int_equal(run(&o, "$BIN/rigctl develop --bilinear --json -o $D/out $D/?.dng 2>/dev/null"), 0);
    assert_int_equal((int)number(o, "n_skipped"), n_before);
    assert_int_equal((int)number(o, "n_developed"), RAWS - n_before);
    json_free(o);
    for (int i = 0; i < RAWS; i++) {
        char path[40];
        struct image im;
        snprintf(path, sizeof(path), "out/%d.exr", i);
        assert_int_equal(image_read(&im, scratch_path(path)), 0);
        image_free(&im);
    }
    assert_int_equal(run(NULL, "test -z \"$(find $D -name '*.part')\" && rm -r $D/out"), 0);
    scratch_empty();
}

static void a_bad_frame_is_named_and_the_others_are_done(void **state)
{
    (void)state;
    struct raw_dng_info info = raw_info(96, 64);
    struct json *o;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    raw_write(scratch_path("b.dng"), &info, raw_scatter, NULL);
    raw_write(scratch_path("c.dng"), &info, raw_scatter, NULL);
    assert_int_equal(truncate(scratch_path("b.dng"), 7000), 0);
    assert_int_equal(run(&o, "$BIN/rigctl develop --half --json -o $D/out $D/a.dng $D/b.dng $D/c.dng $D/none.dng 2>$D/said"), 1);
    assert_int_equal((int)number(o, "n_developed"), 2);
    assert_int_equal((int)number(o, "n_failed"), 2);
    assert_true(text(o, "frames.1.error")[0] != 0);
    json_free(o);
    assert_int_equal(run(NULL, "grep -q b.dng $D/said && grep -q none.dng $D/said && test ! -e $D/out/b.exr -a -e $D/out/a.exr -a -e $D/out/c.exr"), 0);
    assert_int_equal(run(NULL, "mkdir $D/other; cp $D/a.dng $D/other; $BIN/rigctl develop -o $D/out $D/a.dng $D/other/a.dng 2>/dev/null"), 2);
    assert_int_equal(run(NULL, "$BIN/rigctl develop $D/a.dng 2>/dev/null"), 2);
    static const char *const bad[] = { "develop -o $D/out --jobs 0", "develop -o $D/out --exposure 1/0,8,100", "develop -o $D/out --exposure 1,8", "develop -o $D/out --reference-exposure 0,8,100",
                                       "develop -o $D/out --saturation 0", "develop -o $D/out --nonsense", "calibrate colour -o $D/c.json --patch 1,2,0,4", "calibrate colour -o $D/c.json --patch nan,2,3,4",
                                       "calibrate colour -o $D/c.json --chart 1,2,3,4", "calibrate colour --patch 1,2,3,4", "calibrate colour -o $D/c.json" };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
        assert_int_equal(run(NULL, "$BIN/rigctl %s $D/a.dng 2>/dev/null", bad[i]), 2);
    assert_int_equal(run(NULL, "rm -r $D/out $D/other"), 0);
    scratch_empty();
}

static void a_decoder_that_dies_costs_one_frame_and_is_named(void **state)
{
    (void)state;
    static const char program[] = "#!/bin/sh\n"
                                  "for word; do last=$word; done\n"
                                  "case $last in */b.exr) kill -SEGV $$ ;; */c.exr) exit 5 ;; esac\n"
                                  "exec $REAL/rigd-develop \"$@\"\n";
    const struct raw_dng_info info = raw_info(96, 64);
    struct json *o;
    raw_write(scratch_path("a.dng"), &info, raw_scatter, NULL);
    raw_write(scratch_path("b.dng"), &info, raw_scatter, NULL);
    raw_write(scratch_path("c.dng"), &info, raw_scatter, NULL);
    assert_int_equal(run(NULL, "mkdir $D/bin && cp $BIN/rigctl $D/bin"), 0);
    scratch_write("bin/rigd-develop", program, sizeof(program) - 1);
    assert_int_equal(run(&o, "chmod +x $D/bin/rigd-develop; REAL=$(cd $BIN && pwd) $D/bin/rigctl develop --half --json -o $D/out $D/?.dng 2>$D/said"), 1);
    assert_int_equal((int)number(o, "n_developed"), 1);
    assert_non_null(strstr(text(o, "frames.1.error"), "died: Segmentation fault"));
    assert_non_null(strstr(text(o, "frames.2.error"), "status 5"));
    json_free(o);
    assert_int_equal(run(NULL, "grep -q 'b.dng.*died' $D/said && test -e $D/out/a.exr"), 0);
    assert_int_equal(run(NULL, "rm -r $D/bin $D/out"), 0);
    scratch_empty();
}

static uint16_t grey(void *arg, int x, int y)
{
    (void)arg;
    return (uint16_t)(4000 + (x * 31 + y * 17) % 64);
}

static void a_worker_takes_less_memory_than_two_frames(void **state)
{
    (void)state;
#if defined(__SANITIZE_ADDRESS__)
    return; // which takes its own
#endif
    const struct raw_dng_info info = raw_info(4000, 3000);
    struct json *o;
    raw_write(scratch_path("a.dng"), &info, grey, NULL);
    assert_int_equal(run(&o, "$BIN/rigd-develop --ahd $D/a.dng $D/a.exr"), 0);
    assert_true(number(o, "peak_rss_bytes") < 2. * 4000 * 3000 * 6);
    json_free(o);
    scratch_empty();
}

static void the_raw_is_never_overwritten(void **state)
{
    (void)state;
    const struct raw_dng_info info = raw_info(96, 64);
    raw_write(scratch_path("a.exr"), &info, raw_scatter, NULL);
    assert_int_equal(run(NULL, "cp $D/a.exr $D/b; ln $D/a.exr $D/c.tif; $BIN/rigctl develop --half -o $D $D/a.exr >/dev/null 2>&1"), 1);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --half --tiff $D/a.exr $D/c.exr >/dev/null 2>&1"), 1);
    assert_int_equal(run(NULL, "cmp -s $D/a.exr $D/b"), 0);
    scratch_empty();
}

static void a_body_with_other_settings_is_named(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        int iso;
        double f_number, time_s;
        const char *model;
    } body[5] = { { "a.dng", 100, 8, 1. / 128, "X1" }, { "b.dng", 100, 8, 1. / 128, "X1" }, { "c.dng", 200, 8, 1. / 128, "X1" }, { "d.dng", 100, 11, 1. / 128, "X1" }, { "e.dng", 100, 8, 1. / 32, "X2" } };
    struct json *o;
    for (int i = 0; i < 5; i++) {
        struct raw_dng_info info = raw_info(96, 64);
        info.iso = body[i].iso;
        info.f_number = body[i].f_number;
        info.time_s = body[i].time_s;
        info.model = body[i].model;
        raw_write(scratch_path(body[i].name), &info, raw_scatter, NULL);
    }
    assert_int_equal(run(&o, "$BIN/rigctl develop --half --json -o $D/out $D/?.dng 2>/dev/null"), 0);
    static const char *const expected[][3] = { { "camera model", "e.dng has X2", "4 of 5 have X1" }, { "ISO", "c.dng has 200", "4 of 5 have 100" }, { "f-number", "d.dng has 11", "4 of 5 have 8" },
                                               { "exposure time", "e.dng has 0.03125", "4 of 5" } };
    for (int i = 0; i < 4; i++) {
        char path[40];
        snprintf(path, sizeof(path), "warnings.%d", i);
        for (int k = 0; k < 3; k++)
            assert_non_null(strstr(text(o, path), expected[i][k]));
    }
    assert_int_equal(json_length(o, "warnings"), 4);
    json_free(o);
    assert_int_equal(run(&o, "$BIN/rigctl develop --half --json --model X1 -o $D/out $D/?.dng 2>/dev/null"), 3);
    assert_non_null(strstr(text(o, "warnings.4"), "e.dng"));
    json_free(o);
    assert_int_equal(run(NULL, "rm -r $D/out"), 0);
    scratch_empty();
}

// ---- colour ----------------------------------------------------------------------------------------------------------------------

static uint16_t vignetted(void *arg, int x, int y)
{
    const double wb[3] = { .55, 1, .7 }, dx = x / 512. - .5, dy = y / 384. - .5;
    const double *light = arg;
    return (uint16_t)lround(512 + (16383 - 512) * light[0] * wb[(x & 1) + (y & 1)] * (1 - .7 * (dx * dx + dy * dy)));
}

static void the_flat_field_of_this_body_and_aperture_is_taken(void **state)
{
    (void)state;
    struct raw_dng_info info = raw_info(512, 384);
    double light = .7;
    struct image im;
    raw_write(scratch_path("flat8.dng"), &info, vignetted, &light);
    light = .4;
    raw_write(scratch_path("a.dng"), &info, vignetted, &light);
    info.f_number = 11;
    light = .7;
    raw_write(scratch_path("flat11.dng"), &info, raw_scatter, NULL);
    assert_int_equal(run(NULL, "$BIN/rigd-develop --bilinear --flat $D/flat11.dng --flat $D/flat8.dng $D/a.dng $D/a.exr >/dev/null"), 0);
    assert_int_equal(image_read(&im, scratch_path("a.exr")), 0);
    for (int y = 8; y < im.height - 8; y++)
        for (int x = 8; x < im.width - 8; x++)
            for (int c = 0; c < 3; c++)
                assert_true(fabs((double)im.data[(y * im.width + x) * 4 + c] / .4 - 1) < .01);
    image_free(&im);
    for (int k = 0; k < 2; k++) { // a card in a corner and one in the middle are equally bright with it, not without
        struct json *middle, *corner;
        assert_int_equal(run(&middle, "$BIN/rigd-develop --patch 220,160,60,60 %s $D/a.dng", k ? "--flat $D/flat8.dng" : ""), 0);
        assert_int_equal(run(&corner, "$BIN/rigd-develop --patch 20,20,60,60 %s $D/a.dng", k ? "--flat $D/flat8.dng" : ""), 0);
        const double ratio = number(corner, "cells.4.mean.1") / number(middle, "cells.4.mean.1");
        assert_true(k ? fabs(ratio - 1) < .005 : ratio < .85);
        json_free(middle);
        json_free(corner);
    }
    assert_int_equal(run(NULL, "$BIN/rigd-develop --half --flat $D/flat11.dng $D/a.dng $D/b.exr >/dev/null 2>$D/said"), 1);
    assert_int_equal(run(NULL, "grep -q 'no flat field of body 10001.*f/8' $D/said && test ! -e $D/b.exr"), 0);
    scratch_empty();
}

// Six bodies whose channels differ by some percent, in pictures of one scene: apart before, together after a calibration by a card.
static void bodies_with_gains_of_their_own_share_one_space_after_calibration(void **state)
{
    (void)state;
    enum { BODIES = 6 };
    struct scene *card, *scene;
    struct json *o;
    double before = 0, after = 0;
    struct image im;
    assert_int_equal(mkdir(scratch_path("card"), 0777), 0);
    assert_int_equal(image_new(&im, W, H, 3, NULL), 0);
    for (int i = 0; i < W * H * 3; i++) // lit by a warm lamp
        im.data[i] = i % 3 == 0 ? .5f : i % 3 == 1 ? .4f : .25f;
    assert_int_equal(image_write_exr(&im, scratch_path("card/any.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
    write_scene();
    assert_int_equal(scene_open(&card, scratch_path("card"), W, H, 1, any_name), 0);
    assert_int_equal(scene_open(&scene, scratch_path("scene"), W, H, 1, any_name), 0);
    for (unsigned b = 0; b < BODIES; b++) {
        char name[40];
        snprintf(name, sizeof(name), "card%u.dng", b);
        write_frame(name, card, "generic", .06, b, 1. / 128, 8, 100);
        snprintf(name, sizeof(name), "view%u.dng", b);
        write_frame(name, scene, "generic", .06, b, 1. / 128, 8, 100);
    }
    assert_int_equal(run(&o, "$BIN/rigctl --json calibrate colour --patch 100,100,200,150 -o $D/colour.json $D/card?.dng 2>/dev/null"), 0);
    assert_int_equal(json_length(o, "bodies"), BODIES);
    assert_true(number(o, "check.grey_spread") < .01);
    json_free(o);
    assert_int_equal(run(NULL, "$BIN/rigctl develop --half -o $D/plain $D/view?.dng >/dev/null 2>&1"), 0);
    assert_int_equal(run(NULL, "$BIN/rigctl develop --half --colour $D/colour.json -o $D/calibrated $D/view?.dng >/dev/null 2>&1"), 0);
    double mean[2][3], low[2][3], high[2][3];
    for (int k = 0; k < 2; k++)
        for (int b = 0; b < BODIES; b++) {
            char path[100];
            snprintf(path, sizeof(path), "%s/view%d.exr", k ? "calibrated" : "plain", b);
            assert_int_equal(image_read(&im, scratch_path(path)), 0);
            for (int c = 0; c < 3; c++) {
                mean[k][c] = 0;
                for (int i = 0; i < im.width * im.height; i++)
                    mean[k][c] += (double)im.data[4 * i + c] / (im.width * im.height);
                low[k][c] = b ? fmin(low[k][c], mean[k][c]) : mean[k][c];
                high[k][c] = b ? fmax(high[k][c], mean[k][c]) : mean[k][c];
                *(k ? &after : &before) = fmax(k ? after : before, high[k][c] / low[k][c] - 1);
            }
            image_free(&im);
        }
    assert_true(before > .05);
    assert_true(after < .005);
    // The same frames, checked against the file; another body is not in it.
    assert_int_equal(run(NULL, "$BIN/rigctl calibrate colour --patch 320,200,100,100 --check $D/colour.json $D/card?.dng >/dev/null 2>&1"), 0);
    write_frame("card9.dng", card, "generic", .06, 9, 1. / 128, 8, 100);
    assert_int_equal(run(NULL, "$BIN/rigctl calibrate colour --patch 100,100,200,150 --check $D/colour.json $D/card9.dng >/dev/null 2>&1"), 1);
    assert_int_equal(run(NULL, "$BIN/rigctl develop --half --colour $D/colour.json -o $D/calibrated $D/card9.dng >/dev/null 2>&1"), 1);
    scene_close(card);
    scene_close(scene);
    assert_int_equal(run(NULL, "rm -r $D/card $D/scene $D/plain $D/calibrated"), 0);
    scratch_empty();
}

static void a_chart_seen_by_a_noisy_rig_stays_within_its_bounds(void **state)
{
    (void)state;
    struct scene *scene;
    struct image im;
    struct json *o;
    double published[CHART_COLUMNS * CHART_ROWS][3];
    colour_chart(published);
    assert_int_equal(mkdir(scratch_path("chart"), 0777), 0);
    assert_int_equal(image_new(&im, W, H, 3, NULL), 0);
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++) {
            const int u = (x - 16) * 10, v = (y - 32) * 10; // patches of 80 sites from 16, 32; black borders
            const bool border = u < 0 || v < 0 || u >= 4800 || v >= 3200 || u % 800 < 60 || u % 800 > 740 || v % 800 < 60 || v % 800 > 740;
            for (int c = 0; c < 3; c++) // a warm lamp
                im.data[(y * W + x) * 3 + c] = border ? .02f : (float)(published[v / 800 * CHART_COLUMNS + u / 800][c] * (c == 0 ? .8 : c == 1 ? .7 : .5));
        }
    assert_int_equal(image_write_exr(&im, scratch_path("chart/any.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
    assert_int_equal(scene_open(&scene, scratch_path("chart"), W, H, 1, any_name), 0);
    for (unsigned b = 0; b < 4; b++) {
        char name[40];
        snprintf(name, sizeof(name), "chart%u.dng", b);
        write_frame(name, scene, b < 2 ? "generic" : "canon", .06, b, 1. / 128, 8, 100); // bodies of two kinds
    }
    assert_int_equal(run(&o, "$BIN/rigctl --json calibrate colour --chart 16,32,496,32,496,352,16,352 -o $D/colour.json $D/chart?.dng 2>/dev/null"), 0);
    assert_true(number(o, "check.grey_spread") < .01);
    assert_true(number(o, "check.chart_rms_worst") < .03);
    json_free(o);
    scene_close(scene);
    assert_int_equal(run(NULL, "rm -r $D/chart"), 0);
    scratch_empty();
}

static void a_clipped_dark_or_shadowed_card_is_refused_by_name(void **state)
{
    (void)state;
    struct scene *scene;
    struct image im;
    static const char *const wrong[3] = { "is clipped", "too dark", "uneven" };
    const double exposure[3] = { 1. / 16, 1. / 8192, 1. / 128 };
    assert_int_equal(mkdir(scratch_path("card"), 0777), 0);
    assert_int_equal(image_new(&im, W, H, 3, NULL), 0);
    for (int i = 0; i < W * H * 3; i++)
        im.data[i] = i / 3 % W < 300 ? .4f : .2f; // a shadow's edge at column 300
    assert_int_equal(image_write_exr(&im, scratch_path("card/any.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
    assert_int_equal(scene_open(&scene, scratch_path("card"), W, H, 1, any_name), 0);
    write_frame("good.dng", scene, "generic", 0, 0, 1. / 128, 8, 100);
    for (int k = 0; k < 3; k++) {
        write_frame("bad.dng", scene, "generic", 0, 1, exposure[k], 8, 100);
        scratch_write("places.json", "", 0);
        assert_int_equal(run(NULL, "echo '{\"places\": [{\"file\": \"bad.dng\", \"patch\": [%d, 100, 100, 100]}]}' >$D/places.json; "
                                   "$BIN/rigctl calibrate colour --patch 100,100,100,100 --places $D/places.json -o $D/colour.json $D/good.dng $D/bad.dng 2>$D/said",
                             k == 2 ? 250 : 100),
                         1);
        assert_int_equal(run(NULL, "grep 'bad.dng' $D/said | grep -q '%s' && ! grep -q 'good.dng' $D/said && test ! -e $D/colour.json", wrong[k]), 0);
    }
    scene_close(scene);
    assert_int_equal(run(NULL, "rm -r $D/card"), 0);
    scratch_empty();
}

static void a_place_for_a_frame_that_is_not_given_is_said(void **state)
{
    (void)state;
    struct scene *scene;
    struct image im;
    assert_int_equal(mkdir(scratch_path("card"), 0777), 0);
    assert_int_equal(image_new(&im, W, H, 3, NULL), 0);
    for (int i = 0; i < W * H * 3; i++)
        im.data[i] = .4f;
    assert_int_equal(image_write_exr(&im, scratch_path("card/any.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
    assert_int_equal(scene_open(&scene, scratch_path("card"), W, H, 1, any_name), 0);
    write_frame("one.dng", scene, "generic", 0, 0, 1. / 128, 8, 100);
    write_frame("two.dng", scene, "generic", 0, 1, 1. / 128, 8, 100);
    scratch_write("places.json", "", 0);
    // A rig's places, of which some bodies are measured: said, and done.
    assert_int_equal(run(NULL, "for f in one two three; do echo \"{\\\"file\\\": \\\"$f.dng\\\", \\\"patch\\\": [100, 100, 100, 100]},\"; done >$D/all; (echo '{\"places\": ['; sed '$s/,$//' $D/all; echo ']}') >$D/places.json; "
                               "$BIN/rigctl calibrate colour --places $D/places.json -o $D/colour.json $D/one.dng $D/two.dng 2>$D/said >/dev/null"),
                     0);
    assert_int_equal(run(NULL, "grep warning $D/said | grep 'places.json' | grep -q 'three.dng' && test -e $D/colour.json && rm $D/colour.json"), 0);
    // A name with an error in it, where the frame that was meant would be measured at the place for all.
    assert_int_equal(run(NULL, "sed -i 's/two.dng/tow.dng/; s/three.dng/one.dng/' $D/places.json; "
                               "$BIN/rigctl calibrate colour --patch 10,10,50,50 --places $D/places.json -o $D/colour.json $D/one.dng $D/two.dng 2>$D/said >/dev/null"),
                     1);
    assert_int_equal(run(NULL, "grep error $D/said | grep 'places.json' | grep -q 'tow.dng' && test ! -e $D/colour.json"), 0);
    scene_close(scene);
    assert_int_equal(run(NULL, "rm -r $D/card $D/all"), 0);
    scratch_empty();
}

static void without_its_decoder_rigctl_says_so(void **state)
{
    (void)state;
    scratch_write("any.dng", "any", 3);
    assert_int_equal(run(NULL, "mkdir $D/alone && cp $BIN/rigctl $D/alone && $D/alone/rigctl develop $D/any.dng -o $D/out 2>$D/said"), 1);
    assert_int_equal(run(NULL, "grep -c . $D/said | grep -qx 1 && grep 'alone/rigd-develop' $D/said | grep -q 'No such file'"), 0);
    assert_int_equal(run(NULL, "rm -rf $D/alone $D/out"), 0);
    scratch_empty();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(tiff_is_dcraws_bit_for_bit),
        cmocka_unit_test(so_is_that_of_raws_of_real_cameras),
        cmocka_unit_test(radiance_is_what_the_sensor_saw_whatever_body_exposure_and_demosaicing),
        cmocka_unit_test(what_is_saturated_is_marked_and_counted),
        cmocka_unit_test(doubts_are_said_and_change_the_exit_status),
        cmocka_unit_test(the_picture_carries_its_exposure),
        cmocka_unit_test(a_second_run_makes_what_has_changed_and_nothing_else),
        cmocka_unit_test(a_kill_at_any_time_leaves_whole_files_or_none),
        cmocka_unit_test(a_killed_run_goes_on_where_it_was),
        cmocka_unit_test(a_bad_frame_is_named_and_the_others_are_done),
        cmocka_unit_test(a_decoder_that_dies_costs_one_frame_and_is_named),
        cmocka_unit_test(a_worker_takes_less_memory_than_two_frames),
        cmocka_unit_test(the_raw_is_never_overwritten),
        cmocka_unit_test(a_body_with_other_settings_is_named),
        cmocka_unit_test(the_flat_field_of_this_body_and_aperture_is_taken),
        cmocka_unit_test(bodies_with_gains_of_their_own_share_one_space_after_calibration),
        cmocka_unit_test(a_chart_seen_by_a_noisy_rig_stays_within_its_bounds),
        cmocka_unit_test(a_clipped_dark_or_shadowed_card_is_refused_by_name),
        cmocka_unit_test(a_place_for_a_frame_that_is_not_given_is_said),
        cmocka_unit_test(without_its_decoder_rigctl_says_so),
    };
    log_set_program("test");
    if (scratch_open())
        return 1;
    const int failed = cmocka_run_group_tests(tests, NULL, NULL);
    return scratch_close() ? 1 : failed;
}
