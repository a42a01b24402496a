// tests/test_products.c - nothing is made twice, nothing stale is kept, what a person put there is never replaced.
#include "rigd/products.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <cmocka.h>

#include "tests/scratch.h"

enum { N = 3 };
#define LIGHT "20260101T000000000_light"
#define TAKE "20260102T000000000_vase"

static struct config config;
static struct products_site site;
static char takes[600];

static void put(const char *take, const char *name, const char *text)
{
    char path[900], dir[900];
    snprintf(path, sizeof(path), "%s/%s/%s", takes, take, name);
    snprintf(dir, sizeof(dir), "%s", path);
    *strrchr(dir, '/') = 0;
    assert_int_equal(make_directories(dir), 0);
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
}

static char *get(const char *take, const char *name)
{
    char path[900], *text;
    size_t n;
    snprintf(path, sizeof(path), "%s/%s/%s", takes, take, name);
    return file_read(&text, &n, path, 1 << 20) ? NULL : text;
}

static void expect_file(const char *take, const char *name, const char *text)
{
    char *found = get(take, name);
    assert_non_null(found);
    assert_string_equal(found, text);
    free(found);
}

static bool is_there(const char *take, const char *name)
{
    char path[900];
    snprintf(path, sizeof(path), "%s/%s/%s", takes, take, name);
    return !access(path, F_OK);
}

// A verified take of N cameras: A01 with a RAW+JPEG pair, A03 with a JPEG only. Or of the light.
static void make_take(const char *id, bool is_panorama)
{
    struct ledger l;
    char dir[900];
    if (is_panorama)
        ledger_init_panorama(&l, &config);
    else
        ledger_init(&l, &config);
    strcpy(l.id, id);
    l.state = TAKE_VERIFIED;
    for (int i = 0; i < l.n_cameras; i++) {
        const struct camera_object jpeg = { "/store/DCIM/100", "X.JPG", 4 }, raw = { "/store/DCIM/100", "X.NEF", 1000 };
        for (int k = 0; k < 2; k++) {
            if ((k && i == 2) || (!k && i == 1))
                continue;
            struct ledger_object *o = ledger_add(&l.camera[i], k ? &raw : &jpeg);
            o->state = OBJECT_COPIED;
            snprintf(o->xxh128, sizeof(o->xxh128), "%032d", 16 * k + i);
            put(id, o->file, "frame");
        }
        l.camera[i].debt = DEBT_PAID;
    }
    snprintf(dir, sizeof(dir), "%s/%s", takes, id);
    assert_int_equal(make_directories(dir), 0);
    char *text = ledger_text(&l);
    assert_int_equal(ledger_commit(text, dir), 0);
    free(text);
    ledger_free(&l);
    if (is_panorama)
        put(id, "panorama/panorama.json", "{}");
}

static struct products *open_take(const char *id)
{
    struct products *p;
    assert_int_equal(products_open(&p, &site, id), 0);
    return p;
}

struct looked {
    struct processing_item item[8];
    int n;
    char text[PROCESSING_TEXT];
};

static struct looked look(struct products *p, enum processing_step step)
{
    struct looked l = { .n = 0 };
    struct processing_item *items = NULL;
    assert_int_equal(products_look(p, step, &items, &l.n, l.text), 0);
    assert_true(l.n <= 8);
    if (l.n)
        memcpy(l.item, items, (size_t)l.n * sizeof(*items));
    free(items);
    return l;
}

// What a program would do: write the product, say something.
static void make(struct products *p, enum processing_step step, int item, const char *file, const char *said)
{
    struct executor_command c;
    char text[PROCESSING_TEXT];
    assert_int_equal(products_begin(p, step, item, &c, text), 0);
    if (file)
        put(TAKE, file, "product");
    executor_command_free(&c);
    const int err = products_keep(p, step, item, said, 1.5, text);
    if (err)
        fail_msg("%s", text);
}

static bool has_word(const struct executor_command *c, const char *word)
{
    for (int i = 0; i < c->n_words; i++)
        if (!strcmp(c->word[i], word))
            return true;
    return false;
}

// ---- stories ------------------------------------------------------------------------------------------------------------------

static void each_camera_with_a_raw_is_developed_once(void **state)
{
    (void)state;
    struct executor_command c;
    char text[PROCESSING_TEXT];
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    struct looked l = look(p, STEP_DEVELOP);
    assert_int_equal(l.n, N);
    assert_int_equal(l.item[0].verdict, PRODUCT_OWED);
    assert_string_equal(l.item[1].name, "A02");
    assert_string_equal(l.item[1].slot, "usb:1-2");
    assert_int_equal(l.item[2].verdict, PRODUCT_MISSING); // JPEG only
    assert_non_null(strstr(l.item[2].text, "imageformat = raw"));
    assert_int_equal(products_begin(p, STEP_DEVELOP, 0, &c, text), 0);
    assert_true(has_word(&c, "/tools/rigd-develop") && has_word(&c, "--bilinear"));
    assert_non_null(strstr(c.word[c.n_words - 2], TAKE "/raw/A01.nef")); // not the JPEG of the pair
    assert_non_null(strstr(c.word[c.n_words - 1], TAKE "/linear/A01.exr"));
    executor_command_free(&c);
    // Ended well, but nothing is there.
    assert_int_equal(products_keep(p, STEP_DEVELOP, 0, "", 1, text), -ENOENT);
    assert_non_null(strstr(text, "left no linear/A01.exr"));
    make(p, STEP_DEVELOP, 0, "linear/A01.exr", "{\"clipped_share\":0.25,\"warnings\":[\"dark\"]}");
    products_close(p);
    // The next life: what was made of the same raw is there, and what was to be said is said again.
    p = open_take(TAKE);
    struct products_facts facts;
    products_facts(p, &facts);
    assert_int_equal(facts.noted, 1u << STEP_DEVELOP);
    l = look(p, STEP_DEVELOP);
    assert_int_equal(l.item[0].verdict, PRODUCT_THERE);
    assert_string_equal(l.item[0].text, "dark");
    assert_int_equal(l.item[1].verdict, PRODUCT_OWED);
    // Cut short, or made otherwise: anew.
    put(TAKE, "linear/A01.exr", "prod");
    assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_OWED);
    put(TAKE, "linear/A01.exr", "product");
    assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_THERE);
    config.process.demosaic = DEVELOP_AHD;
    assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_OWED);
    config.process.demosaic = DEVELOP_BILINEAR;
    snprintf(config.process.colour, sizeof(config.process.colour), "%.200s/colour.json", scratch_dir);
    scratch_write("colour.json", "{}", 2);
    assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_DEVELOP, 0, &c, text), 0);
    assert_true(has_word(&c, config.process.colour));
    executor_command_free(&c);
    config.process.colour[0] = 0;
    unlink(scratch_path("colour.json"));
    // Asked for anew: forgotten, and the next life knows that it is owed.
    assert_int_equal(products_forget(p, 1u << STEP_DEVELOP), 0);
    products_close(p);
    p = open_take(TAKE);
    products_facts(p, &facts);
    assert_int_equal(facts.noted, 1u << STEP_DEVELOP);
    assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_OWED);
    products_close(p);
}

static void a_size_that_cannot_be_is_no_memory_to_count_with(void **state)
{
    (void)state;
    struct ledger l;
    char dir[900];
    make_take(TAKE, false);
    snprintf(dir, sizeof(dir), "%s/" TAKE, takes);
    assert_int_equal(ledger_read(&l, dir), 0);
    for (int k = 0; k < l.camera[0].n_objects; k++)
        l.camera[0].object[k].object.size_bytes = INT64_MAX;
    char *text = ledger_text(&l);
    assert_int_equal(ledger_commit(text, dir), 0);
    free(text);
    ledger_free(&l);
    struct products *p = open_take(TAKE);
    const struct looked looked = look(p, STEP_DEVELOP);
    assert_true(looked.item[0].memory_bytes > INT64_C(1) << 40); // of 200 such the sum is still a number
    assert_true(looked.item[0].memory_bytes < INT64_MAX / 1000);
    products_close(p);
}

static void the_light_is_the_newest_panorama_before_the_take(void **state)
{
    (void)state;
    struct executor_command c;
    char text[PROCESSING_TEXT];
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    struct looked l = look(p, STEP_PANORAMA);
    assert_int_equal(l.n, 0);
    assert_non_null(strstr(l.text, "no panorama take"));
    make_take("20250101T000000000_old", true);
    put("20250101T000000000_old", "panorama.exr", "old light");
    make_take(LIGHT, true);
    make_take("20270101T000000000_later", true);
    put("20270101T000000000_later", "panorama.exr", "later light");
    l = look(p, STEP_PANORAMA);
    assert_int_equal(l.item[0].verdict, PRODUCT_WAITS);
    assert_string_equal(l.item[0].name, LIGHT);
    put(LIGHT, "panorama.exr", "light");
    put(LIGHT, "panorama-report.json", "{\"findings\":[{\"doubtful\":false,\"text\":\"fine\"},{\"doubtful\":true,\"stop\":\"s02\",\"text\":\"clips\"}]}");
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_PANORAMA, 0, &c, text), 0);
    assert_int_equal(c.n_words, 0); // file work
    assert_int_equal(products_keep(p, STEP_PANORAMA, 0, "", 0, text), 0);
    assert_string_equal(text, "not to be trusted: s02: clips");
    expect_file(TAKE, "panorama.exr", "light");
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_THERE);
    // Merged anew there: it is another one. The linked name is replaced, not written through.
    char path[900];
    snprintf(path, sizeof(path), "%s/" LIGHT "/panorama.exr", takes);
    unlink(path);
    put(LIGHT, "panorama.exr", "better");
    expect_file(TAKE, "panorama.exr", "light");
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_OWED);
    make(p, STEP_PANORAMA, 0, NULL, "");
    expect_file(TAKE, "panorama.exr", "better");
    expect_file(LIGHT, "panorama.exr", "better");
    // Asked for anew, though nothing has changed: one file with two names, and no third.
    assert_int_equal(products_forget(p, 1u << STEP_PANORAMA), 0);
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_OWED);
    make(p, STEP_PANORAMA, 0, NULL, "");
    struct stat st;
    assert_int_equal(stat(path, &st), 0);
    assert_int_equal(st.st_nlink, 2);
    products_close(p);
    // Somebody's own is never replaced.
    make_take("20260103T000000000_own", false);
    put("20260103T000000000_own", "panorama.exr", "mine");
    p = open_take("20260103T000000000_own");
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_THERE);
    products_close(p);
    // The panorama take itself is merged by its program.
    p = open_take(LIGHT);
    assert_int_equal(look(p, STEP_PANORAMA).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_PANORAMA, 0, &c, text), 0);
    assert_true(has_word(&c, "/tools/rigd-panorama"));
    executor_command_free(&c);
    products_close(p);
}

static void geometry_of_a_hook_of_a_fixed_rig_or_ones_own(void **state)
{
    (void)state;
    struct executor_command c;
    char text[PROCESSING_TEXT];
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    assert_non_null(strstr(look(p, STEP_RECONSTRUCT).text, "no mesh and no cameras"));
    put(TAKE, "geometry/mesh.obj", "own");
    assert_non_null(strstr(look(p, STEP_RECONSTRUCT).text, "has no cameras"));
    put(TAKE, "geometry/cameras.csv", "own");
    strcpy(config.process.command, "hook --fast");
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_THERE); // without a note: somebody's own
    // Asked for anew, the hook is run; killed while it wrote, what lies there is not believed.
    assert_int_equal(products_forget(p, 1u << STEP_RECONSTRUCT), 0);
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_RECONSTRUCT, 0, &c, text), 0);
    assert_int_equal(c.n_words, 3);
    assert_string_equal(c.word[1], "--fast");
    assert_non_null(strstr(c.word[2], TAKE));
    assert_non_null(strstr(c.log_path, "log/reconstruct.log"));
    executor_command_free(&c);
    put(TAKE, "geometry/mesh.obj", "half");
    products_close(p);
    p = open_take(TAKE);
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_OWED);
    make(p, STEP_RECONSTRUCT, 0, NULL, "");
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_THERE);
    put(TAKE, "linear/A01.exr", "a new picture");
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_OWED); // it was made from others
    products_close(p);
    // A fixed rig's.
    config.process.command[0] = 0;
    snprintf(config.process.calibrated, sizeof(config.process.calibrated), "%.200s/fixed", scratch_dir);
    char dir[300];
    snprintf(dir, sizeof(dir), "%.200s/fixed/cameras", scratch_dir);
    assert_int_equal(make_directories(dir), 0);
    scratch_write("fixed/mesh.ply", "fixed", 5);
    scratch_write("fixed/start.json", "{}", 2);
    scratch_write("fixed/cameras/a.xmp", "a", 1);
    make_take("20260104T000000000_fixed", false);
    p = open_take("20260104T000000000_fixed");
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_OWED);
    make(p, STEP_RECONSTRUCT, 0, NULL, "");
    expect_file("20260104T000000000_fixed", "geometry/mesh.ply", "fixed");
    expect_file("20260104T000000000_fixed", "geometry/cameras/a.xmp", "a");
    expect_file("20260104T000000000_fixed", "start.json", "{}");
    assert_false(is_there("20260104T000000000_fixed", "geometry/start.json"));
    // The hook that leaves nothing is told so.
    products_close(p);
    config.process.calibrated[0] = 0;
    strcpy(config.process.command, "hook");
    make_take("20260105T000000000_lazy", false);
    p = open_take("20260105T000000000_lazy");
    assert_int_equal(look(p, STEP_RECONSTRUCT).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_RECONSTRUCT, 0, &c, text), 0);
    executor_command_free(&c);
    assert_int_equal(products_keep(p, STEP_RECONSTRUCT, 0, "", 0, text), -ENOENT);
    assert_non_null(strstr(text, "left no mesh.* and cameras"));
    products_close(p);
    config.process.command[0] = 0;
}

static void a_solve_gets_its_name_when_it_is_whole(void **state)
{
    (void)state;
    struct executor_command c;
    char text[PROCESSING_TEXT];
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    assert_non_null(strstr(look(p, STEP_PREVIEW).text, "geometry/mesh.* geometry/cameras panorama.exr linear/*.exr"));
    put(TAKE, "geometry/mesh.obj", "m"), put(TAKE, "geometry/cameras.csv", "c"), put(TAKE, "panorama.exr", "p"), put(TAKE, "linear/A01.exr", "v");
    strcpy(config.process.options, "--lights 64");
    put(TAKE, "solve/.preview.part/left", "of an earlier life");
    assert_int_equal(look(p, STEP_PREVIEW).item[0].verdict, PRODUCT_OWED);
    assert_int_equal(products_begin(p, STEP_PREVIEW, 0, &c, text), 0);
    assert_true(has_word(&c, "solve") && has_word(&c, "preview") && has_word(&c, "64") && has_word(&c, "3") && c.progress);
    assert_false(is_there(TAKE, "solve/.preview.part/left"));
    executor_command_free(&c);
    put(TAKE, "solve/.preview.part/report.json", "{\"trusted\":");
    log_set_level(LOG_SILENT);
    assert_int_equal(products_keep(p, STEP_PREVIEW, 0, "", 2, text), -EINVAL);
    log_set_level(LOG_INFO);
    assert_non_null(strstr(text, "log/preview.log"));
    assert_false(is_there(TAKE, "solve/preview"));
    put(TAKE, "solve/.preview.part/report.json", "{\"trusted\":false,\"rmse_held_out_percent\":2.5,\"warnings\":[\"too few views\"]}");
    assert_int_equal(products_keep(p, STEP_PREVIEW, 0, "", 2, text), 0);
    assert_string_equal(text, "not to be trusted: too few views");
    assert_true(is_there(TAKE, "solve/preview/report.json"));
    assert_int_equal(look(p, STEP_PREVIEW).item[0].verdict, PRODUCT_THERE);
    put(TAKE, "geometry/cameras.csv", "others");
    assert_int_equal(look(p, STEP_PREVIEW).item[0].verdict, PRODUCT_OWED);
    // The one before stays until the next one is whole, then goes.
    assert_int_equal(products_begin(p, STEP_PREVIEW, 0, &c, text), 0);
    executor_command_free(&c);
    assert_true(is_there(TAKE, "solve/preview/report.json"));
    put(TAKE, "solve/.preview.part/report.json", "{\"trusted\":true}");
    assert_int_equal(products_keep(p, STEP_PREVIEW, 0, "", 2, text), 0);
    expect_file(TAKE, "solve/preview/report.json", "{\"trusted\":true}");
    assert_false(is_there(TAKE, "solve/.preview.part"));
    products_close(p);
    config.process.options[0] = 0;
}

static void take_json_says_what_became_of_it(void **state)
{
    (void)state;
    struct processing_record record = { .state = TAKE_SOLVED, .processing = LEDGER_SETTLED, .n_notes = 1 };
    struct executor_command c;
    struct ledger l;
    char text[PROCESSING_TEXT], dir[900];
    snprintf(dir, sizeof(dir), "%s/" TAKE, takes);
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    look(p, STEP_DEVELOP);
    make(p, STEP_DEVELOP, 1, "linear/A02.exr", "{\"clipped_share\":0.125}");
    put(TAKE, "geometry/mesh.obj", "m"), put(TAKE, "geometry/cameras.csv", "c"), put(TAKE, "panorama.exr", "p");
    look(p, STEP_FINAL);
    assert_int_equal(products_begin(p, STEP_FINAL, 0, &c, text), 0);
    executor_command_free(&c);
    put(TAKE, "solve/.final.part/report.json", "{\"trusted\":true}");
    assert_int_equal(products_keep(p, STEP_FINAL, 0, "", 7, text), 0);
    products_close(p);
    strcpy(record.note[0], "develop: camera A01 (usb:1-1): \"refused\"");
    assert_int_equal(products_record(dir, &record), 0);
    assert_int_equal(ledger_read(&l, dir), 0);
    assert_int_equal(l.state, TAKE_SOLVED);
    assert_int_equal(l.processing, LEDGER_SETTLED);
    assert_string_equal(l.process_note[0], record.note[0]);
    assert_string_equal(l.camera[0].developed, "");
    assert_string_equal(l.camera[1].developed, "linear/A02.exr");
    assert_true(l.camera[1].clipped_share == .125);
    assert_true(l.camera[1].developed_s == 1.5);
    assert_int_equal(l.n_solves, 1);
    assert_string_equal(l.solve[0].name, "final");
    assert_true(l.solve[0].trusted && isnan(l.solve[0].rmse_held_out_percent) && l.solve[0].seconds == 7);
    // A take that failed stays failed, whatever was made of its frames.
    l.state = TAKE_FAILED;
    char *failed = ledger_text(&l);
    assert_int_equal(ledger_commit(failed, dir), 0);
    free(failed);
    ledger_free(&l);
    assert_int_equal(products_record(dir, &record), 0);
    assert_int_equal(ledger_read(&l, dir), 0);
    assert_int_equal(l.state, TAKE_FAILED);
    ledger_free(&l);
}

static void a_broken_memory_costs_work_and_nothing_else(void **state)
{
    (void)state;
    static const char *const broken[] = { "", "[]", "{\"format\":\"studiorig processing 1\"}", "{\"format\":\"studiorig processing 9\",\"products\":[]}",
        "{\"format\":\"studiorig processing 1\",\"products\":[{\"step\":\"develop\",\"item\":\"A01\",\"state\":\"made\",\"key\":\"k\",\"file\":\"../../etc/passwd\"}]}",
        "{\"format\":\"studiorig processing 1\",\"products\":[{\"step\":\"nonsense\",\"state\":\"made\"}]}",
        "{\"format\":\"studiorig processing 1\",\"products\":[{\"step\":\"develop\",\"item\":\"A012345678901234567890123456789\",\"state\":\"made\"}]}" };
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(broken) / sizeof(broken[0]); i++) {
        struct products_facts facts;
        make_take(TAKE, false);
        put(TAKE, "processing.json", broken[i]);
        struct products *p = open_take(TAKE);
        products_facts(p, &facts);
        assert_int_equal(facts.noted, 0);
        assert_true(is_there(TAKE, "processing.json.damaged"));
        assert_int_equal(look(p, STEP_DEVELOP).item[0].verdict, PRODUCT_OWED);
        products_close(p);
    }
    struct products *p;
    assert_int_equal(products_open(&p, &site, "20260109T000000000_nowhere"), -ENOENT);
    log_set_level(LOG_INFO);
}

static void what_a_killed_program_had_begun_is_removed_and_nothing_else(void **state)
{
    (void)state;
    static const char *const ours[] = { ".panorama.exr.abcdef.part", "linear/.A01.exr.abcdef.part", "sheet/.linear.png.abcdef.part", "geometry/.mesh.obj.abcdef.part" };
    static const char *const others[] = { "raw/A01.nef.part", "thumbnails/A01.jpg.part", ".take.json.abcdef.part", "linear/A01.exr", "geometry/mesh.part" };
    make_take(TAKE, false);
    for (int i = 0; i < 4; i++)
        put(TAKE, ours[i], "half");
    for (int i = 0; i < 5; i++)
        put(TAKE, others[i], "copying");
    products_close(open_take(TAKE));
    for (int i = 0; i < 4; i++)
        assert_false(is_there(TAKE, ours[i]));
    for (int i = 0; i < 5; i++)
        assert_true(is_there(TAKE, others[i]));
}

static void a_failed_program_is_quoted(void **state)
{
    (void)state;
    char text[PROCESSING_TEXT];
    make_take(TAKE, false);
    struct products *p = open_take(TAKE);
    products_complaint(p, STEP_DEVELOP, "rigd-develop: error: develop: raw/A01.nef: cut short", 1, text);
    assert_string_equal(text, "develop: raw/A01.nef: cut short");
    products_complaint(p, STEP_DEVELOP, "", 9, text);
    assert_non_null(strstr(text, "exit 9"));
    put(TAKE, "log/preview.log", "a\nrigsolve: error: cameras: no views\nlast words\n");
    products_complaint(p, STEP_PREVIEW, "", 1, text);
    assert_non_null(strstr(text, "rigsolve: error: cameras: no views"));
    assert_non_null(strstr(text, "log/preview.log"));
    products_close(p);
}

static int remove_one(const char *path, const struct stat *st, int flag, struct FTW *ftw)
{
    (void)st, (void)flag, (void)ftw;
    return remove(path);
}

static int set_up(void **state)
{
    (void)state;
    if (scratch_open())
        return -1;
    snprintf(takes, sizeof(takes), "%s/takes", scratch_dir);
    config = (struct config){ .objects_per_shot = 1, .n_cameras = N, .process = { .develop = true, .demosaic = DEVELOP_BILINEAR } };
    config.camera = calloc(N, sizeof(*config.camera));
    for (int i = 0; i < N; i++) {
        snprintf(config.camera[i].name, sizeof(config.camera[i].name), "A%02d", i + 1);
        snprintf(config.camera[i].port, sizeof(config.camera[i].port), "usb:1-%d", i + 1);
    }
    site = (struct products_site){ .config = &config, .takes_dir = takes, .programs_dir = "/tools", .n_threads = 3 };
    return make_directories(takes);
}

static int tear_down(void **state)
{
    (void)state;
    config_free(&config);
    return nftw(scratch_dir, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(each_camera_with_a_raw_is_developed_once, set_up, tear_down),
        cmocka_unit_test_setup_teardown(a_size_that_cannot_be_is_no_memory_to_count_with, set_up, tear_down),
        cmocka_unit_test_setup_teardown(the_light_is_the_newest_panorama_before_the_take, set_up, tear_down),
        cmocka_unit_test_setup_teardown(geometry_of_a_hook_of_a_fixed_rig_or_ones_own, set_up, tear_down),
        cmocka_unit_test_setup_teardown(a_solve_gets_its_name_when_it_is_whole, set_up, tear_down),
        cmocka_unit_test_setup_teardown(take_json_says_what_became_of_it, set_up, tear_down),
        cmocka_unit_test_setup_teardown(a_broken_memory_costs_work_and_nothing_else, set_up, tear_down),
        cmocka_unit_test_setup_teardown(what_a_killed_program_had_begun_is_removed_and_nothing_else, set_up, tear_down),
        cmocka_unit_test_setup_teardown(a_failed_program_is_quoted, set_up, tear_down),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
