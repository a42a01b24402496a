// tests/test_ledger.c - a take survives anything: killed at every call, power cut, full and failing disks, broken files.
//
// The calls that make things durable are defined here; they count, fail or kill as a story wants (the linker prefers them to libc's).
// The story is a whole take as rigd makes it: folder, armed ledger, each frame noted, copied, noted again, manifest, verified.
#include "rigd/ledger.h"
#include "rigd/ingest.h"
#include "rigd/manifest.h"
#include "solver/take/log.h"

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <fcntl.h>
#include <ftw.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>
#include <cmocka.h>

enum { N = 3, FRAME_BYTES = 5000, INODES_MAX = 4096 };
#define ID "20261122T090000000_story"

// ---- the disk, shared with the child that is killed -----------------------------------------------------------------------------------

static struct disk {
    int step, kill_at, fail_at, fail;
    bool kill_after, for_good; // for_good: every step from fail_at on fails
    struct { ino_t inode; off_t size; } synced[INODES_MAX];
    int n_synced;
} *disk;

static bool on_step(void)
{
    disk->step++;
    if (disk->step == disk->kill_at && !disk->kill_after)
        raise(SIGKILL);
    if (disk->fail && (disk->for_good ? disk->step >= disk->fail_at : disk->step == disk->fail_at)) {
        errno = disk->fail;
        return false;
    }
    return true;
}

static int after(int result)
{
    if (disk->step == disk->kill_at)
        raise(SIGKILL);
    return result;
}

int fsync(int fd)
{
    struct stat st;
    if (!on_step())
        return -1;
    const int result = 0; // noted, not done: the story is about order, and disks are slow
    if (!fstat(fd, &st) && S_ISREG(st.st_mode) && disk->n_synced < INODES_MAX) {
        disk->synced[disk->n_synced].inode = st.st_ino;
        disk->synced[disk->n_synced++].size = st.st_size;
    }
    return after(result);
}

int rename(const char *from, const char *to)
{
    return on_step() ? after((int)syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0)) : -1;
}

int renameat2(int from_dir, const char *from, int to_dir, const char *to, unsigned flags)
{
    return on_step() ? after((int)syscall(SYS_renameat2, from_dir, from, to_dir, to, flags)) : -1;
}

int mkdir(const char *path, mode_t mode)
{
    return on_step() ? after((int)syscall(SYS_mkdirat, AT_FDCWD, path, mode)) : -1;
}

int unlink(const char *path)
{
    return on_step() ? after((int)syscall(SYS_unlinkat, AT_FDCWD, path, 0)) : -1;
}

ssize_t write(int fd, const void *bytes, size_t n)
{
    if (fd <= 2)
        return syscall(SYS_write, fd, bytes, n);
    if (!on_step())
        return -1;
    const ssize_t wrote = syscall(SYS_write, fd, bytes, n > 1000 ? 1000 : n);
    after(0);
    return wrote;
}

// Power goes: what was not synced is gone. (Every file's last synced length counts.)
static void cut_power(const char *dir)
{
    DIR *d = opendir(dir);
    for (const struct dirent *e; d && (e = readdir(d));) {
        char path[700];
        struct stat st;
        snprintf(path, sizeof(path), "%s/%s", dir, e->d_name);
        if (!strcmp(e->d_name, ".") || !strcmp(e->d_name, "..") || lstat(path, &st))
            continue;
        if (S_ISDIR(st.st_mode)) {
            cut_power(path);
            continue;
        }
        off_t size = 0;
        for (int i = 0; i < disk->n_synced; i++)
            if (disk->synced[i].inode == st.st_ino)
                size = disk->synced[i].size;
        if (size < st.st_size)
            assert_int_equal(truncate(path, size), 0);
    }
    if (d)
        closedir(d);
}

// ---- a take ------------------------------------------------------------------------------------------------------------------------

static char takes[60], take_dir[120];

static void make_config(struct config *c)
{
    memset(c, 0, sizeof(*c));
    c->n_cameras = N;
    c->objects_per_shot = 1;
    c->camera = calloc(N, sizeof(*c->camera));
    for (int i = 0; i < N; i++) {
        snprintf(c->camera[i].name, sizeof(c->camera[i].name), "A%02d", i);
        snprintf(c->camera[i].serial, sizeof(c->camera[i].serial), "600%d", i);
        snprintf(c->camera[i].port, sizeof(c->camera[i].port), "usb:1-%d", i + 1);
    }
}

// What a card holds: the frame before the take, and the take's.
static void on_card(struct camera_object *o, int camera, int number)
{
    *o = (struct camera_object){ "/store_00010001/DCIM/100NIKON", "", FRAME_BYTES + camera };
    snprintf(o->name, sizeof(o->name), "DSC_%04d.NEF", number);
}

static unsigned char byte_of(int camera, int at)
{
    return (unsigned char)(camera * 31 + at * 7 + at / 256);
}

static int commit(struct ledger *l)
{
    char *text = ledger_text(l);
    const int err = ledger_commit(text, take_dir);
    free(text);
    return err;
}

static int copy_frame(struct ledger_object *o, int camera)
{
    char path[200];
    struct ingest *s;
    unsigned char bytes[FRAME_BYTES + N];
    const size_t n = (size_t)(FRAME_BYTES + camera);
    for (size_t i = 0; i < n; i++)
        bytes[i] = byte_of(camera, (int)i);
    snprintf(path, sizeof(path), "%s/%s", take_dir, o->file);
    if (!access(path, F_OK))
        return ingest_adopt(path, o->xxh128, &o->object.size_bytes);
    int err = ingest_begin(&s, path);
    if (err)
        return err;
    err = ingest_write(s, bytes, n);
    if (err) {
        ingest_abort(s);
        return err;
    }
    return ingest_finish(s, o->xxh128, &o->object.size_bytes);
}

// From whatever the ledger says to the end. What the rig does, without its cameras.
static int finish_take(struct ledger *l)
{
    int err = 0;
    for (int i = 0; i < N; i++) {
        struct ledger_camera *c = &l->camera[i];
        struct camera_object o;
        on_card(&o, i, 2);
        assert_true(ledger_owns(c, &o));
        if (!ledger_find(c, &o))
            ledger_add(c, &o);
    }
    err = commit(l); // names before copies
    for (int i = 0; i < N && !err; i++) {
        struct ledger_camera *c = &l->camera[i];
        for (int k = 0; k < c->n_objects && !err; k++)
            if (c->object[k].state == OBJECT_FOUND) {
                err = copy_frame(&c->object[k], i);
                if (err)
                    return err;
                c->object[k].state = OBJECT_COPIED;
            }
        c->debt = DEBT_PAID;
        err = commit(l);
    }
    if (!err)
        err = manifest_write(take_dir, NULL, 0, 1795338000);
    if (!err) {
        l->state = TAKE_VERIFIED;
        err = commit(l);
    }
    return err;
}

static int whole_story(void)
{
    struct config config;
    struct ledger l;
    make_config(&config);
    ledger_init(&l, &config);
    strcpy(l.id, ID);
    strcpy(l.name, "story");
    l.state = TAKE_ARMED;
    for (int i = 0; i < N; i++) {
        l.camera[i].n_before = 1;
        on_card(&l.camera[i].before[0], i, 1);
    }
    char *text = ledger_text(&l);
    int err = ledger_create(text, LEDGER_CAPTURE, ID, takes);
    free(text);
    if (!err)
        err = finish_take(&l);
    ledger_free(&l);
    config_free(&config);
    return err;
}

static int remove_entry(const char *path, const struct stat *st, int type, struct FTW *where)
{
    (void)st, (void)type;
    return where->level ? remove(path) : 0; // libc's own: no step
}

static void remove_take(void)
{
    nftw(takes, remove_entry, 16, FTW_DEPTH | FTW_PHYS);
    memset(disk, 0, sizeof(*disk));
}

static int n_entries(const char *dir)
{
    int n = 0;
    DIR *d = opendir(dir);
    for (const struct dirent *e; d && (e = readdir(d));)
        n += e->d_name[0] != '.';
    if (d)
        closedir(d);
    return n;
}

static int n_hidden(const char *dir)
{
    int n = 0;
    DIR *d = opendir(dir);
    for (const struct dirent *e; d && (e = readdir(d));)
        n += e->d_name[0] == '.' && strcmp(e->d_name, ".") && strcmp(e->d_name, "..");
    if (d)
        closedir(d);
    return n;
}

// 0 lost, 0 doubled, 0 partial; ledger, folder and manifest agree.
static void check_whole(void)
{
    struct ledger l;
    struct manifest_findings found;
    char path[200];
    assert_int_equal(ledger_read(&l, take_dir), 0);
    assert_int_equal(l.state, TAKE_VERIFIED);
    assert_true(ledger_is_whole(&l));
    snprintf(path, sizeof(path), "%s/raw", take_dir);
    assert_int_equal(n_entries(path), N);
    for (int i = 0; i < N; i++) {
        assert_int_equal(l.camera[i].n_objects, 1);
        snprintf(path, sizeof(path), "%s/%s", take_dir, l.camera[i].object[0].file);
        FILE *f = fopen(path, "r");
        assert_non_null(f);
        for (int k = 0; k < FRAME_BYTES + i; k++)
            assert_int_equal(getc(f), byte_of(i, k));
        assert_int_equal(getc(f), EOF);
        fclose(f);
    }
    assert_int_equal(manifest_verify(take_dir, &found), 0);
    assert_int_equal(found.n_files, N);
    assert_int_equal(found.n_new, 0);
    ledger_free(&l);
}

// The next start of the daemon.
static void resume_and_check(void)
{
    struct ledger l;
    struct ledger_findings found;
    memset(disk, 0, sizeof(*disk));
    const int err = ledger_read(&l, take_dir);
    if (err == -ENOENT) { // no folder under its name: it was never armed
        ledger_remove_leftovers(takes);
        assert_int_equal(n_hidden(takes), 0);
        assert_int_equal(access(take_dir, F_OK), -1);
        assert_int_equal(whole_story(), 0);
        check_whole();
        return;
    }
    assert_int_equal(err, 0); // never half a ledger
    assert_int_equal(ledger_reconcile(&l, take_dir, &found), 0);
    assert_int_equal(found.n_taken_back, 0); // the ledger never claims what is not there
    assert_int_equal(found.n_strangers, 0);
    assert_int_equal(ledger_bound(&l, takes), 0);
    assert_int_equal(finish_take(&l), 0);
    ledger_free(&l);
    check_whole();
}

static void killed_at_every_call_a_take_is_finished_by_the_next_start(void **state)
{
    (void)state;
    int n = 0;
    for (int power = 0; power < 2; power++)
        for (int late = 0; late < 2; late++)
            for (int step = 1;; step++) {
                int status;
                remove_take();
                disk->kill_at = step;
                disk->kill_after = late;
                const pid_t child = fork();
                if (!child) {
                    log_set_level(LOG_SILENT);
                    _exit(whole_story() ? 1 : 0);
                }
                assert_int_equal(waitpid(child, &status, 0), child);
                if (WIFEXITED(status)) {
                    assert_int_equal(WEXITSTATUS(status), 0);
                    check_whole();
                    break;
                }
                n++;
                if (power)
                    cut_power(takes);
                resume_and_check();
            }
    assert_true(n > 4 * 50);
}

static void a_full_or_failing_disk_costs_no_frame(void **state)
{
    (void)state;
    const int errors[] = { ENOSPC, EIO };
    log_set_level(LOG_SILENT);
    for (int e = 0; e < 2; e++)
        for (int good = 0; good < 2; good++)
            for (int step = 1;; step++) {
                remove_take();
                disk->fail_at = step;
                disk->fail = errors[e];
                disk->for_good = good;
                const int err = whole_story();
                const int steps = disk->step;
                disk->fail = 0;
                if (steps < step) {
                    assert_int_equal(err, 0);
                    break;
                }
                if (err) // some calls may fail without harm: removing what is not there
                    resume_and_check();
                else
                    check_whole();
            }
    log_set_level(LOG_INFO);
}

static void what_rotted_on_disk_is_noticed_set_aside_and_fetched_again(void **state)
{
    (void)state;
    struct ledger l;
    struct ledger_findings found;
    char path[200];
    log_set_level(LOG_SILENT);
    remove_take();
    assert_int_equal(whole_story(), 0);
    snprintf(path, sizeof(path), "%s/raw/A00.nef", take_dir);
    FILE *f = fopen(path, "r+");
    fputc('!', f);
    fclose(f);
    snprintf(path, sizeof(path), "%s/raw/A01.nef", take_dir);
    assert_int_equal(truncate(path, 10), 0);
    snprintf(path, sizeof(path), "%s/raw/A02.nef", take_dir);
    remove(path);
    snprintf(path, sizeof(path), "%s/raw/holiday.jpg", take_dir);
    fclose(fopen(path, "w"));
    assert_int_equal(ledger_read(&l, take_dir), 0);
    assert_int_equal(ledger_reconcile(&l, take_dir, &found), 0);
    assert_int_equal(found.n_taken_back, 3);
    assert_int_equal(found.n_strangers, 1);
    for (int i = 0; i < N; i++) {
        assert_int_equal(l.camera[i].object[0].state, OBJECT_FOUND);
        assert_int_equal(l.camera[i].debt, DEBT_OPEN);
    }
    assert_int_equal(access(path, F_OK), 0); // strangers are left alone
    snprintf(path, sizeof(path), "%s/raw/A00.nef.damaged", take_dir);
    assert_int_equal(access(path, F_OK), 0);
    ledger_free(&l);
    // One whose card copy was deleted is lost, and said to be.
    remove_take();
    assert_int_equal(whole_story(), 0);
    assert_int_equal(ledger_read(&l, take_dir), 0);
    l.camera[0].object[0].state = OBJECT_DELETED;
    snprintf(path, sizeof(path), "%s/raw/A00.nef", take_dir);
    remove(path);
    assert_int_equal(ledger_reconcile(&l, take_dir, &found), 0);
    assert_int_equal(l.camera[0].object[0].state, OBJECT_GONE);
    assert_false(ledger_is_whole(&l));
    ledger_free(&l);
    log_set_level(LOG_INFO);
}

// A daemon that is killed while it writes down how far a verified take was processed: nobody reconciles that one any more.
static void half_a_ledger_of_a_finished_take_is_swept_at_the_next_start(void **state)
{
    static const char *const names[] = { "raw/B01.nef.part", ".take.json.7gXk2a.part", ".processing.json.7gXk2a.part" }; // others' are theirs
    char path[3][1100];
    (void)state;
    assert_int_equal(whole_story(), 0);
    for (int i = 0; i < 3; i++) {
        snprintf(path[i], sizeof(path[i]), "%s/%s", take_dir, names[i]);
        const int fd = open(path[i], O_WRONLY | O_CREAT, 0644);
        assert_true(fd >= 0);
        close(fd);
    }
    ledger_remove_leftovers(takes);
    for (int i = 0; i < 3; i++)
        assert_int_equal(access(path[i], F_OK), i == 1 ? -1 : 0);
    for (int i = 0; i < 3; i += 2)
        unlink(path[i]);
    check_whole();
    remove_take();
}

static void exposures_are_called_as_on_dials(void **state)
{
    (void)state;
    static const struct { double seconds; const char *label; double time; } cases[] = {
        { 1. / 125, "1/125", 0x1p-7 }, { 1. / 60, "1/60", 0x1p-6 }, { 1. / 8000, "1/8000", 0x1p-13 }, { 15, "15", 16 }, { 30, "30", 32 }, { .5, "0.5", .5 },
        { 1. / 100, "1/100", 0x1p-7 * 1.2599210498948732 }, { 1e-9, "1/8000", 0x1p-13 }, { 1e9, "30", 32 }, { .25, "1/4", .25 }, { 1, "1", 1 }, { 1. / 1000, "1/1000", 0x1p-10 },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        char label[16];
        const double t = ledger_exposure_label(cases[i].seconds, label);
        assert_string_equal(label, cases[i].label);
        assert_true(fabs(t / cases[i].time - 1) < 1e-12);
    }
    for (int third = -39; third <= 15; third++) { // each is nearest to what its name says
        char label[16], again[16];
        double above, below = 1;
        const double t = ledger_exposure_label(exp2(third / 3.), label);
        assert_true(sscanf(label, "%lf/%lf", &above, &below) >= 1);
        assert_true(fabs(log2(above / below / t)) < 1. / 6);
        assert_true(ledger_exposure_label(above / below, again) == t);
    }
}

static void a_stage_made_anew_replaces_the_one_before_and_old_ledgers_have_none(void **state)
{
    (void)state;
    struct config config;
    struct ledger l, back;
    make_config(&config);
    ledger_init(&l, &config);
    strcpy(l.id, "20260101T000000000_line");
    strcpy(l.name, "line");
    char *text = ledger_text(&l);
    assert_null(strstr(text, "time_line"));
    assert_int_equal(ledger_parse(&back, text, strlen(text), "test"), 0);
    assert_int_equal(back.n_stages, 0);
    ledger_free(&back);
    free(text);
    ledger_note_stage(&l, "button", 1000, 1250);
    ledger_note_stage(&l, "preview", 2000, 9000);
    ledger_note_stage(&l, "standard", 9000, 50000);
    ledger_note_stage(&l, "preview", 60000, 66000);
    text = ledger_text(&l);
    assert_int_equal(ledger_parse(&back, text, strlen(text), "test"), 0);
    assert_int_equal(back.n_stages, 3);
    assert_string_equal(back.stage[1].name, "preview");
    assert_int_equal(back.stage[1].began_utc_ms, 60000);
    assert_int_equal(back.stage[1].ended_utc_ms, 66000);
    assert_int_equal(back.stage[0].ended_utc_ms, 1250);
    for (int i = 0; i < 2 * LEDGER_STAGES_MAX; i++) { // more than there is room for: the first ones stay
        char name[16];
        snprintf(name, sizeof(name), "s%d", i);
        ledger_note_stage(&l, name, i, i);
    }
    assert_int_equal(l.n_stages, LEDGER_STAGES_MAX);
    assert_string_equal(l.stage[0].name, "button");
    free(text);
    ledger_free(&back);
    ledger_free(&l);
    free(config.camera);
}

static void a_panorama_s_ledger_reads_back_as_it_was_written(void **state)
{
    (void)state;
    struct config config;
    struct ledger l, back;
    make_config(&config);
    strcpy(config.panorama.camera_name, config.camera[2].name);
    config.panorama.camera = 2;
    config.panorama.n_stops = 2;
    config.panorama.stop[1] = (struct config_stop){ 120.5, -10 };
    ledger_init(&l, &config);
    assert_false(l.camera[2].expected);
    assert_true(l.camera[1].expected);
    ledger_free(&l);
    ledger_init_panorama(&l, &config);
    strcpy(l.id, ID);
    l.state = TAKE_EXPOSING;
    for (int e = 0; e < 3; e++) {
        struct camera_object o;
        assert_int_equal(ledger_expose(&l, &config, e > 1, e % 2, exp2(-6 - e)), e);
        on_card(&o, 1, 100 + e);
        struct ledger_object *added = ledger_add(&l.camera[e], &o);
        added->state = OBJECT_COPIED;
        strcpy(added->xxh128, "0123456789abcdef0123456789abcdef");
    }
    assert_string_equal(l.camera[1].name, "00_01");
    assert_string_equal(l.camera[2].object[0].file, "panorama/raw/01_00.nef");
    l.camera[0].debt = DEBT_PAID;
    l.camera[0].exposure.object = 0;
    l.camera[0].exposure.facts = (struct frame_facts){ 8, 100, "6001", { .exposure_s = 0x1p-6, .n_sites = { 10, 20, 10 }, .n_over = { 1, 2, 3 }, .brightest = { .5, 1, .25 },
        .first_percentile = { -.001, .002, 0 }, .median = { .1, .2, .3 }, .plateau_dn = 15000 } };
    l.camera[1].exposure.rejected = true;
    char *text = ledger_text(&l);
    assert_int_equal(ledger_parse(&back, text, strlen(text), "t"), 0);
    assert_int_equal(back.kind, LEDGER_PANORAMA);
    assert_int_equal(back.n_stops, 2);
    assert_memory_equal(l.stop, back.stop, sizeof(l.stop));
    assert_memory_equal(l.camera, back.camera, 3 * sizeof(*l.camera));
    char *again = ledger_text(&back);
    assert_string_equal(text, again);
    log_set_level(LOG_SILENT);
    static const char *const wrong[][2] = { { "\"stop\":1", "\"stop\":2" }, { "panorama/raw/01_00.nef", "raw/01_00.nef" }, { "\"kind\":\"panorama\"", "\"kind\":\"capture\"" },
        { "\"object\":0", "\"object\":1" }, { "\"brightest\":[0.5", "\"brightest\":[1e300" }, { "\"wanted_s\":", "\"wanted_s\":-" }, { "panorama/raw/01_00.nef", "panorama/raw/../../x" } };
    for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++) {
        char bad[20000];
        const char *at = strstr(text, wrong[i][0]);
        struct ledger none;
        if (!at)
            fail_msg("%s is not in it", wrong[i][0]);
        snprintf(bad, sizeof(bad), "%.*s%s%s", (int)(at - text), text, wrong[i][1], at + strlen(wrong[i][0]));
        if (ledger_parse(&none, bad, strlen(bad), "t") != -EINVAL)
            fail_msg("%s was taken", wrong[i][1]);
    }
    log_set_level(LOG_INFO);
    free(text), free(again);
    ledger_free(&l), ledger_free(&back);
    free(config.camera);
}

static void a_ledger_reads_back_as_it_was_written(void **state)
{
    (void)state;
    struct config config;
    struct ledger l, back;
    make_config(&config);
    ledger_init(&l, &config);
    strcpy(l.id, ID), strcpy(l.name, "story"), strcpy(l.created, "2026-11-22T09:00:00Z"), strcpy(l.reason, "\"why\" not"), strcpy(l.panorama_take, "20261121T080000_light");
    l.state = TAKE_FAILED, l.spread_ns = 123456789, l.sigma_ns = 5, l.n_measured = 3, l.jitter_ns = -4, l.shot_utc_ms = 1795338000123, l.synchronised = true;
    struct ledger_camera *c = &l.camera[1];
    c->debt = DEBT_MISSED, c->lag_ns = -7, c->delay_us = 990000, c->battery_percent = 0, c->expected = true;
    strcpy(c->note, "check its card"), strcpy(c->model, "D850"), strcpy(c->firmware, "1.2"), strcpy(c->lens, "50 mm");
    c->n_settings = 1;
    c->setting[0] = (struct camera_setting_found){ "iso", "100", "100", true, false };
    c->n_before = 2;
    on_card(&c->before[0], 1, 9999);
    on_card(&c->before[1], 1, 17);
    for (int k = 0; k < LEDGER_OBJECTS_MAX; k++) {
        struct camera_object o;
        on_card(&o, 1, 100 + k);
        assert_non_null(ledger_add(c, &o));
        c->object[k].state = OBJECT_DELETED;
        c->object[k].copied_ms = k;
        c->object[k].n_retries = k;
        strcpy(c->object[k].xxh128, "0123456789abcdef0123456789abcdef");
    }
    struct camera_object more;
    on_card(&more, 1, 500);
    assert_null(ledger_add(c, &more));
    char *text = ledger_text(&l);
    assert_int_equal(ledger_parse(&back, text, strlen(text), "t"), 0);
    assert_memory_equal(l.camera, back.camera, N * sizeof(*l.camera));
    char *again = ledger_text(&back);
    assert_string_equal(text, again);
    // Every truncation of it is an error, not a crash and not half a ledger.
    log_set_level(LOG_SILENT);
    for (size_t n = 0; n < strlen(text); n += 7) {
        struct ledger part;
        assert_true(ledger_parse(&part, text, n, "t") < 0);
        assert_null(part.camera);
    }
    static const char *const edits[][2] = {
        { "raw/A01.nef", "../A01.nef" }, { "raw/A01_2.nef", "raw/A01.nef" }, { "\"A02\"", "\"A01\"" }, { "\"A02\"", "\"A/2\"" }, { "\"deleted\"", "\"eaten\"" },
        { "0123456789abcdef0123456789abcdef", "" }, { "studiorig take 1", "studiorig take 2" }, { ID, "../../etc" }, { "20261121T080000_light", "../../light" }, { "DSC_0100.NEF", "../../x" },
    };
    for (size_t i = 0; i < sizeof(edits) / sizeof(edits[0]); i++) {
        struct ledger bad;
        char *edited = calloc(1, strlen(text) + 100), *at = strstr(text, edits[i][0]);
        assert_non_null(at);
        sprintf(edited, "%.*s%s%s", (int)(at - text), text, edits[i][1], at + strlen(edits[i][0]));
        if (ledger_parse(&bad, edited, strlen(edited), "t") != -EINVAL)
            fail_msg("accepted %s", edits[i][1]);
        free(edited);
    }
    log_set_level(LOG_INFO);
    free(text), free(again);
    ledger_free(&l), ledger_free(&back), config_free(&config);
}

static void frames_of_later_takes_are_not_ours(void **state)
{
    (void)state;
    struct ledger l;
    struct camera_object ours, theirs, elsewhere = { "/store_00020001/DCIM/100NIKON", "DSC_0001.NEF", 1 };
    remove_take();
    assert_int_equal(whole_story(), 0);
    // A later take whose card notes say that DSC_0004 was there before it.
    assert_int_equal(ledger_read(&l, take_dir), 0);
    for (int i = 0; i < N; i++)
        on_card(&l.camera[i].before[0], i, 4);
    strcpy(l.id, "20261122T100000000_later");
    char *later = ledger_text(&l);
    assert_int_equal(ledger_create(later, LEDGER_CAPTURE, l.id, takes), 0);
    free(later);
    ledger_free(&l);
    assert_int_equal(ledger_read(&l, take_dir), 0);
    on_card(&ours, 0, 4);
    on_card(&theirs, 0, 5);
    assert_true(ledger_owns(&l.camera[0], &theirs));
    assert_int_equal(ledger_bound(&l, takes), 0);
    assert_true(ledger_owns(&l.camera[0], &ours));
    assert_false(ledger_owns(&l.camera[0], &theirs));
    assert_false(ledger_owns(&l.camera[0], &elsewhere)); // that card came later
    ledger_free(&l);
}

static int set_up(void **state)
{
    (void)state;
    disk = mmap(NULL, sizeof(*disk), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    const char *tmp = getenv("TMPDIR");
    if (!access("/dev/shm", W_OK)) // the disk is played here: a real one only makes hundreds of takes slow
        tmp = "/dev/shm";
    if (snprintf(takes, sizeof(takes), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp") >= (int)sizeof(takes))
        return -1;
    if (disk == MAP_FAILED || !mkdtemp(takes))
        return -1;
    snprintf(take_dir, sizeof(take_dir), "%s/%s", takes, ID);
    return 0;
}

static int tear_down(void **state)
{
    (void)state;
    remove_take();
    return rmdir(takes);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_ledger_reads_back_as_it_was_written),
        cmocka_unit_test(a_stage_made_anew_replaces_the_one_before_and_old_ledgers_have_none),
        cmocka_unit_test(a_panorama_s_ledger_reads_back_as_it_was_written),
        cmocka_unit_test(half_a_ledger_of_a_finished_take_is_swept_at_the_next_start),
        cmocka_unit_test(exposures_are_called_as_on_dials),
        cmocka_unit_test(killed_at_every_call_a_take_is_finished_by_the_next_start),
        cmocka_unit_test(a_full_or_failing_disk_costs_no_frame),
        cmocka_unit_test(what_rotted_on_disk_is_noticed_set_aside_and_fetched_again),
        cmocka_unit_test(frames_of_later_takes_are_not_ours),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
