// tests/test_take.c - a take's folder, and what it stands on: files that are whole or not there,
// the log, progress.
#include "solver/take/take.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/take/progress.h"
#include "tests/scratch.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <pthread.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>
#include <cmocka.h>

static struct {
    int n[LOG_SILENT];
    char text[8192];
} logged;

static void keep_line(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    logged.n[level]++;
    const size_t n = strlen(logged.text);
    snprintf(logged.text + n, sizeof(logged.text) - n, "%s\n", message);
}

static void listen(void)
{
    memset(&logged, 0, sizeof(logged));
}

static void assert_logged(int n_errors, const char *words)
{
    if (logged.n[LOG_ERROR] != n_errors || !strstr(logged.text, words))
        fail_msg("%d errors, expected %d with \"%s\": %s", logged.n[LOG_ERROR], n_errors, words,
                 logged.text);
}

static void put(const char *path, const char *text)
{
    FILE *f = fopen(path, "w");
    if (!f)
        fail_msg("cannot write %s", path);
    fputs(text, f);
    fclose(f);
}

static void assert_holds(const char *path, const char *text)
{
    char *bytes;
    size_t n;
    assert_int_equal(file_read(&bytes, &n, path, 1 << 20), 0);
    assert_string_equal(bytes, text);
    assert_int_equal(n, strlen(text));
    free(bytes);
}

static int remove_one(const char *path, const struct stat *st, int type, struct FTW *ftw)
{
    (void)st, (void)type, (void)ftw;
    return remove(path);
}

static void remove_all(const char *path)
{
    nftw(path, remove_one, 8, FTW_DEPTH | FTW_PHYS);
}

static int n_files(const char *dir, const char *with)
{
    int n = 0;
    DIR *d = opendir(dir);
    assert_non_null(d);
    for (struct dirent *e; (e = readdir(d));)
        n += e->d_name[strspn(e->d_name, ".")] && strstr(e->d_name, with);
    closedir(d);
    return n;
}

static int fresh_folder(void **state)
{
    (void)state;
    log_set_hook(keep_line, NULL);
    log_set_level(LOG_SILENT);
    listen();
    return scratch_open();
}

static int remove_folder(void **state)
{
    (void)state;
    remove_all(scratch_dir);
    return 0;
}

// ---- atomic files ---------------------------------------------------------------------------

static void the_name_holds_the_old_file_until_commit_and_the_new_one_after(void **state)
{
    (void)state;
    struct atomic_file f;
    const char *path = scratch_path("report.json");
    put(path, "old");
    assert_int_equal(atomic_file_open(&f, path), 0);
    fputs("new", f.stream);
    fflush(f.stream);
    assert_holds(path, "old");
    assert_int_equal(n_files(scratch_dir, ".part"), 1);
    assert_int_equal(atomic_file_commit(&f), 0);
    assert_holds(path, "new");
    assert_int_equal(n_files(scratch_dir, ""), 1);
    assert_null(f.stream);
    atomic_file_abandon(&f); // harmless

    struct stat st;
    const mode_t mask = umask(0);
    umask(mask);
    assert_int_equal(stat(path, &st), 0);
    assert_int_equal(st.st_mode & 0777,
                     0666 & ~mask); // as any file, not as a private temporary one
}

static void abandon_leaves_no_trace(void **state)
{
    (void)state;
    struct atomic_file f;
    assert_int_equal(atomic_file_open(&f, scratch_path("a.txt")), 0);
    fputs("half", f.stream);
    atomic_file_abandon(&f);
    assert_int_equal(n_files(scratch_dir, ""), 0);
    struct atomic_file zeroed = { 0 };
    atomic_file_abandon(&zeroed);
}

static void a_writer_killed_before_commit_leaves_the_old_file(void **state)
{
    (void)state;
    const char *path = scratch_path("take.json");
    put(path, "old");
    for (int how = 0; how < 2; how++) {
        int status = 0;
        const pid_t child = fork();
        if (child == 0) {
            struct atomic_file f;
            if (atomic_file_open(&f, path))
                _exit(1);
            fputs("half of the new", f.stream);
            fflush(f.stream);
            if (how)
                kill(getpid(), SIGKILL);
            _exit(0);
        }
        assert_int_equal(waitpid(child, &status, 0), child);
        assert_true(how ? WIFSIGNALED(status) : WIFEXITED(status) && WEXITSTATUS(status) == 0);
        assert_holds(path, "old");
    }
    // The strays are hidden, and the next writer is not disturbed by them.
    struct atomic_file f;
    assert_int_equal(n_files(scratch_dir, ".part"), 2);
    assert_int_equal(atomic_file_open(&f, path), 0);
    fputs("new", f.stream);
    assert_int_equal(atomic_file_commit(&f), 0);
    assert_holds(path, "new");
}

static void two_writers_of_one_name_do_not_mix(void **state)
{
    (void)state;
    struct atomic_file a, b;
    const char *path = scratch_path("both");
    assert_int_equal(atomic_file_open(&a, path), 0);
    assert_int_equal(atomic_file_open(&b, path), 0);
    fputs("aaaa", a.stream);
    fputs("b", b.stream);
    assert_int_equal(atomic_file_commit(&a), 0);
    assert_holds(path, "aaaa");
    assert_int_equal(atomic_file_commit(&b), 0);
    assert_holds(path, "b");
    assert_int_equal(n_files(scratch_dir, ""), 1);
}

static void a_full_device_is_an_error_and_keeps_the_old_file(void **state)
{
    (void)state;
    struct atomic_file f;
    const char *path = scratch_path("old");
    put(path, "old");
    assert_int_equal(atomic_file_open(&f, path), 0);
    // The part's descriptor becomes the device that is always full: flushing fails as on a full
    // disk.
    const int full = open("/dev/full", O_RDWR);
    assert_true(full >= 0 && dup2(full, fileno(f.stream)) >= 0);
    close(full);
    fputs("new", f.stream);
    listen();
    assert_int_equal(atomic_file_commit(&f), -ENOSPC);
    assert_logged(1, "free some space");
    assert_holds(path, "old");
    assert_int_equal(n_files(scratch_dir, ""), 1);
}

static void an_error_while_writing_is_not_forgotten_at_commit(void **state)
{
    (void)state;
    struct atomic_file f;
    put(scratch_path("old"), "old");
    assert_int_equal(atomic_file_open(&f, scratch_path("old")), 0);
    const int kept = dup(fileno(f.stream)), full = open("/dev/full", O_RDWR);
    assert_true(kept >= 0 && full >= 0 && dup2(full, fileno(f.stream)) >= 0);
    setvbuf(f.stream, NULL, _IONBF, 0);
    fputs("lost", f.stream);
    dup2(kept, fileno(f.stream)); // the disk has room again, but the file has a hole
    close(kept);
    close(full);
    fputs("new", f.stream);
    assert_true(atomic_file_commit(&f) < 0);
    assert_holds(scratch_path("old"), "old");
}

static void places_that_cannot_be_written_are_named(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        int err;
    } cases[] = { { "no/such/folder", -ENOENT },
                  { "file/below", -ENOTDIR },
                  { "dir", -EISDIR },
                  { "dir/", -EISDIR } };
    struct atomic_file f;
    put(scratch_path("file"), "");
    assert_int_equal(mkdir(scratch_path("dir"), 0777), 0);
    for (int i = 0; i < 4; i++) {
        listen();
        assert_int_equal(atomic_file_open(&f, scratch_path(cases[i].name)), cases[i].err);
        assert_logged(1, cases[i].name);
        assert_null(f.stream);
        atomic_file_abandon(&f);
    }
    listen();
    assert_int_equal(atomic_file_open(&f, "/dev/null"), -EINVAL);
    assert_logged(1, "/dev/null");
    struct stat st;
    assert_int_equal(stat("/dev/null", &st), 0);
    assert_true(S_ISCHR(st.st_mode));
    listen();
    assert_int_equal(atomic_file_open(&f, ""), -EISDIR);
    assert_logged(1, "without a name");
    assert_int_equal(n_files(scratch_dir, ""), 2);
}

static void commit_by_path_keeps_the_same_promises(void **state)
{
    (void)state;
    const char *path = scratch_path("model.glb");
    put(path, "old");
    char *part = atomic_file_part_path(path);
    assert_non_null(part);
    assert_int_equal(strncmp(part, scratch_dir, strlen(scratch_dir)), 0);
    put(part, "new");
    assert_holds(path, "old");
    assert_int_equal(atomic_file_commit_path(part, path), 0);
    assert_holds(path, "new");
    listen();
    assert_int_equal(atomic_file_commit_path(part, path), -ENOENT); // nothing was written this time
    assert_logged(1, "model.glb");
    assert_holds(path, "new");
    assert_int_equal(n_files(scratch_dir, ""), 1);
    free(part);
    part = atomic_file_part_path("bare");
    assert_null(strchr(part, '/'));
    free(part);
}

static void make_directories_makes_parents_and_minds_files(void **state)
{
    (void)state;
    struct stat st;
    assert_int_equal(make_directories(scratch_path("a/b//c/")), 0);
    assert_int_equal(stat(scratch_path("a/b/c"), &st), 0);
    assert_int_equal(make_directories(scratch_path("a/b")), 0);
    assert_int_equal(make_directories("/"), 0);
    put(scratch_path("a/file"), "");
    listen();
    assert_int_equal(make_directories(scratch_path("a/file/d")), -ENOTDIR);
    assert_logged(1, "a/file");
    listen();
    assert_int_equal(make_directories(""), -ENOENT);
    assert_logged(1, "folder");
}

static void whole_files_are_read_up_to_the_limit(void **state)
{
    (void)state;
    char *bytes;
    size_t n;
    put(scratch_path("five"), "12345");
    assert_int_equal(file_read(&bytes, &n, scratch_path("five"), 5), 0);
    assert_string_equal(bytes, "12345");
    free(bytes);
    listen();
    assert_int_equal(file_read(&bytes, &n, scratch_path("five"), 4), -EFBIG);
    assert_logged(1, "five");
    assert_null(bytes);
    put(scratch_path("none"), "");
    assert_int_equal(file_read(&bytes, &n, scratch_path("none"), 5), 0);
    assert_true(n == 0 && bytes[0] == 0);
    free(bytes);

    // A pipe has no size: more than the first guess goes through, and the limit holds.
    // 65537 is one more than the first guess.
    static const struct {
        int n_bytes, limit, err;
    } cases[] = { { 200000, 200000, 0 }, { 200000, 199999, -EFBIG }, { 65537, 65537, 0 } };
    for (int c = 0; c < 3; c++) {
        char fd_path[64];
        int ends[2];
        assert_int_equal(pipe(ends), 0);
        const pid_t child = fork();
        if (child == 0) {
            signal(SIGPIPE, SIG_IGN);
            close(ends[0]);
            for (int i = 0; i < cases[c].n_bytes; i++)
                if (write(ends[1], &"0123456789"[i % 10], 1) != 1)
                    break;
            _exit(0);
        }
        close(ends[1]);
        snprintf(fd_path, sizeof(fd_path), "/dev/fd/%d", ends[0]);
        assert_int_equal(file_read(&bytes, &n, fd_path, (size_t)cases[c].limit), cases[c].err);
        if (!cases[c].err) {
            assert_int_equal(n, cases[c].n_bytes);
            assert_int_equal(bytes[n - 1], "0123456789"[(n - 1) % 10]);
        }
        free(bytes);
        close(ends[0]);
        waitpid(child, NULL, 0);
    }
}

// ---- the take folder ------------------------------------------------------------------------

static void a_new_take_has_its_folders_and_manifest_and_nothing_to_solve(void **state)
{
    (void)state;
    struct take *take;
    const char *dir = scratch_path("takes/one");
    const char *string;
    assert_int_equal(take_create(dir, "vase \"1\"", "2026-11-22T03:00:00Z", "open"), 0);
    assert_int_equal(take_open(&take, dir), 0);
    assert_string_equal(take->dir, dir);
    assert_int_equal(json_get_string(take->manifest, "name", &string), 0);
    assert_string_equal(string, "vase \"1\"");
    assert_int_equal(json_get_string(take->manifest, "created", &string), 0);
    assert_string_equal(string, "2026-11-22T03:00:00Z");
    assert_int_equal(json_get_string(take->manifest, "state", &string), 0);
    assert_string_equal(string, "open");
    assert_int_equal(json_get_string(take->manifest, "format", &string), 0);
    assert_null(take->mesh_path);
    assert_null(take->cameras_path); // the folder is there, but empty
    assert_null(take->panorama_path);
    assert_null(take->start_path);
    assert_non_null(take->linear_dir);
    assert_int_equal(take->n_views, 0);

    listen();
    assert_int_equal(
        take_require(take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS | TAKE_START),
        -ENOENT);
    assert_logged(5, "mesh.obj");
    assert_logged(5, "geometry/cameras");
    assert_logged(5, "rigctl panorama");
    assert_logged(5, "rigctl develop");
    assert_logged(5, "start.json");
    listen();
    assert_int_equal(take_require(take, TAKE_PANORAMA), -ENOENT);
    assert_logged(1, "takes/one lacks panorama.exr");
    assert_int_equal(take_require(take, 0), 0);
    take_close(take);

    listen();
    assert_int_equal(take_create(dir, "again", "2026-11-22T03:00:01Z", "open"), -EEXIST);
    assert_logged(1, "takes/one");
    assert_int_equal(mkdir(scratch_path("empty"), 0777), 0);
    assert_int_equal(
        take_create(scratch_path("empty"), "in an empty folder", "2026-11-22T03:00:00Z", "open"),
        0);
    take_close(NULL);
}

static void equal_takes_have_equal_manifests(void **state)
{
    (void)state;
    char *bytes[2];
    size_t n[2];
    for (int i = 0; i < 2; i++) {
        assert_int_equal(
            take_create(scratch_path(i ? "b" : "a"), "name", "2026-11-22T03:00:00Z", "open"), 0);
        assert_int_equal(
            file_read(&bytes[i], &n[i], scratch_path(i ? "b/take.json" : "a/take.json"), 1 << 20),
            0);
    }
    assert_int_equal(n[0], n[1]);
    assert_memory_equal(bytes[0], bytes[1], n[0]);
    free(bytes[0]);
    free(bytes[1]);
}

static void every_piece_is_found_and_views_are_sorted(void **state)
{
    (void)state;
    static const char *const files[] = {
        "linear/cam010.exr",  "linear/cam002.TIF",  "linear/B.hdr",
        "linear/a.tiff",      "linear/notes.txt",   "linear/.cam003.exr.abcdef.part",
        "linear/.hidden.exr", "linear/cam.two.exr", "geometry/mesh.glb",
        "geometry/mesh.bin",  "geometry/other.obj", "geometry/cameras/cameras.txt",
        "panorama.exr",       "start.json",         "README"
    };
    static const char *const views[] = { "B", "a", "cam.two", "cam002", "cam010" };
    struct take *take;
    assert_int_equal(make_directories(scratch_path("linear")), 0);
    assert_int_equal(make_directories(scratch_path("linear/folder.exr")), 0);
    assert_int_equal(make_directories(scratch_path("geometry/cameras")), 0);
    for (size_t i = 0; i < sizeof(files) / sizeof(files[0]); i++)
        put(scratch_path(files[i]), "{}");
    assert_int_equal(take_open(&take, scratch_dir), 0);
    assert_null(take->manifest); // a plain folder is a take as well
    assert_int_equal(take->n_views, 5);
    for (int i = 0; i < 5; i++)
        assert_string_equal(take->view_names[i], views[i]);
    assert_string_equal(take->view_paths[3], scratch_path("linear/cam002.TIF"));
    assert_string_equal(take->mesh_path, scratch_path("geometry/mesh.glb"));
    assert_string_equal(take->cameras_path, scratch_path("geometry/cameras"));
    assert_string_equal(take->panorama_path, scratch_path("panorama.exr"));
    assert_string_equal(take->start_path, scratch_path("start.json"));
    assert_string_equal(take->linear_dir, scratch_path("linear"));
    assert_int_equal(
        take_require(take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS | TAKE_START), 0);
    assert_int_equal(logged.n[LOG_ERROR] + logged.n[LOG_WARNING], 0);
    take_close(take);
}

static void a_tools_export_under_its_own_name_is_found(void **state)
{
    (void)state;
    static const char *const names[] = { "scan.xml", "IMG_1.XMP", "scan.csv", "sfm.json", "a.sfm", "bundle.out" };
    struct take *take;
    for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
        char path[64];
        assert_int_equal(make_directories(scratch_path("geometry/cameras")), 0); // as take_create left it
        put(scratch_path("geometry/mesh.obj"), "");
        put(scratch_path("geometry/mesh.mtl"), "");
        snprintf(path, sizeof(path), "geometry/%s", names[i]);
        put(scratch_path(path), "");
        assert_int_equal(take_open(&take, scratch_dir), 0);
        assert_string_equal(take->cameras_path, scratch_path("geometry"));
        take_close(take);
        assert_int_equal(unlink(scratch_path(path)), 0);
        assert_int_equal(take_open(&take, scratch_dir), 0);
        assert_null(take->cameras_path);
        take_close(take);
    }
}

static void cameras_may_be_one_file_and_a_second_mesh_is_warned_of(void **state)
{
    (void)state;
    struct take *take;
    assert_int_equal(make_directories(scratch_path("geometry/cameras")),
                     0); // empty: the file counts
    put(scratch_path("geometry/cameras.xml"), "");
    put(scratch_path("geometry/mesh.ply"), "");
    put(scratch_path("geometry/mesh.obj"), "");
    put(scratch_path("panorama.hdr"), "");
    listen();
    assert_int_equal(take_open(&take, scratch_dir), 0);
    assert_string_equal(take->cameras_path, scratch_path("geometry/cameras.xml"));
    assert_string_equal(take->mesh_path, scratch_path("geometry/mesh.obj"));
    assert_string_equal(take->panorama_path, scratch_path("panorama.hdr"));
    assert_null(take->linear_dir);
    assert_int_equal(logged.n[LOG_WARNING], 1);
    assert_non_null(strstr(logged.text, "mesh.ply is not"));
    take_close(take);
}

static void two_views_of_one_stem_are_refused(void **state)
{
    (void)state;
    struct take *take;
    assert_int_equal(make_directories(scratch_path("linear")), 0);
    put(scratch_path("linear/cam1.exr"), "");
    put(scratch_path("linear/cam1-b.exr"), "");
    put(scratch_path("linear/cam1.tif"), "");
    listen();
    assert_int_equal(take_open(&take, scratch_dir), -EINVAL);
    assert_logged(1, "cam1.exr");
    assert_logged(1, "cam1.tif");
    assert_null(take);
}

static void a_broken_manifest_and_a_missing_folder_are_named(void **state)
{
    (void)state;
    struct take *take;
    put(scratch_path("take.json"), "{\n\"name\": }");
    listen();
    assert_int_equal(take_open(&take, scratch_dir), -EINVAL);
    assert_logged(1, "take.json:2:");
    assert_null(take);
    listen();
    assert_int_equal(take_open(&take, scratch_path("nowhere")), -ENOENT);
    assert_logged(1, "nowhere");
    listen();
    assert_int_equal(take_open(&take, scratch_path("take.json")), -ENOTDIR);
    assert_logged(1, "take.json");
}

static void real_studios_open_as_takes(void **state)
{
    (void)state;
    static const char *const dirs[] = { "../shared/data/studio-pebble",
                                        "../shared/data/studio-vase" };
    if (access("../shared/data", F_OK)) {
        fprintf(stderr, "test_take: no ../shared/data here: real studios not tried\n");
        return;
    }
    for (int i = 0; i < 2; i++) {
        struct take *take;
        assert_int_equal(take_open(&take, dirs[i]), 0);
        assert_int_equal(take->n_views, 85);
        assert_string_equal(take->view_names[84], "cam084");
        assert_int_equal(
            take_require(take, TAKE_MESH | TAKE_CAMERAS | TAKE_PANORAMA | TAKE_VIEWS | TAKE_START),
            0);
        take_close(take);
    }
}

// ---- log and progress -----------------------------------------------------------------------

// What a child writes to stderr.
static void stderr_of(void (*body)(void), char *out, size_t size)
{
    int ends[2];
    size_t n = 0;
    assert_int_equal(pipe(ends), 0);
    const pid_t child = fork();
    if (child == 0) {
        dup2(ends[1], STDERR_FILENO);
        log_set_hook(NULL, NULL);
        log_set_level(LOG_INFO);
        log_set_program("test");
        body();
        _exit(0);
    }
    close(ends[1]);
    for (ssize_t got; n < size - 1 && (got = read(ends[0], out + n, size - 1 - n)) > 0;)
        n += (size_t)got;
    out[n] = 0;
    close(ends[0]);
    waitpid(child, NULL, 0);
}

static void log_as_text(void)
{
    log_error("mesh: %s:%d: no triangles", "evil\nname\033[2J.obj", 12);
    log_debug("mesh: below the level");
    log_warning("no module here");
}

static void log_as_json(void)
{
    log_set_json(true);
    log_error("mesh: \"a\\b\"\n\xff\xc3\xa9\xed\xa0\x80: tail");
    log_info("no module here");
}

static void a_line_of_the_log_stays_one_line(void **state)
{
    (void)state;
    char text[2048];
    stderr_of(log_as_text, text, sizeof(text));
    assert_string_equal(
        text,
        "test: error: mesh: evil?name?[2J.obj:12: no triangles\ntest: warning: no module here\n");
    stderr_of(log_as_json, text, sizeof(text));
    assert_string_equal(text,
                        "{\"level\":\"error\",\"module\":\"mesh\",\"message\":"
                        "\"\\\"a\\\\b\\\"\\u000a\\ufffd\xc3\xa9"
                        "\\ufffd\\ufffd\\ufffd: tail\"}\n"
                        "{\"level\":\"info\",\"module\":\"\",\"message\":\"no module here\"}\n");
    struct json *doc;
    *strchr(text, '\n') = 0;
    assert_int_equal(json_parse(&doc, text, strlen(text), "log"), 0); // and it is JSON
    json_free(doc);
}

static void progress_of_nobody_is_silent(void)
{
    progress_begin("render", 10);
    progress_add(5);
    progress_end();
    progress_add(1); // between stages: nothing
}

static void *add_many(void *arg)
{
    for (int i = 0; i < 10000; i++)
        progress_add(1);
    return arg;
}

static void progress_counts_from_all_threads_and_reports_begin_and_end(void **state)
{
    (void)state;
    char text[65536], *line, *rest;
    int ends[2], n_lines = 0;
    double last_done = -1, last_s = -1;
    stderr_of(progress_of_nobody_is_silent, text, sizeof(text));
    assert_string_equal(text, ""); // no terminal: no bar

    assert_int_equal(pipe(ends), 0);
    progress_set_fd(ends[1]);
    progress_begin("visibility", 40000);
    pthread_t threads[4];
    for (int i = 0; i < 4; i++)
        assert_int_equal(pthread_create(&threads[i], NULL, add_many, NULL), 0);
    for (int i = 0; i < 4; i++)
        pthread_join(threads[i], NULL);
    progress_end();
    progress_set_fd(-1);
    close(ends[1]);
    const ssize_t n = read(ends[0], text, sizeof(text) - 1);
    close(ends[0]);
    assert_true(n > 0);
    text[n] = 0;
    for (line = strtok_r(text, "\n", &rest); line; line = strtok_r(NULL, "\n", &rest), n_lines++) {
        struct json *doc;
        const char *stage;
        double done, total, seconds;
        assert_int_equal(json_parse(&doc, line, strlen(line), "progress"), 0);
        assert_int_equal(json_get_string(doc, "stage", &stage), 0);
        assert_string_equal(stage, "visibility");
        assert_int_equal(json_get_number(doc, "done", &done), 0);
        assert_int_equal(json_get_number(doc, "total", &total), 0);
        assert_int_equal(json_get_number(doc, "seconds", &seconds), 0);
        assert_true(total == 40000 && done >= last_done && seconds >= last_s);
        if (n_lines == 0)
            assert_true(done == 0);
        last_done = done, last_s = seconds;
        json_free(doc);
    }
    assert_true(n_lines >= 2 && last_done == 40000);
}

static void a_reader_of_progress_that_went_away_does_not_end_the_work(void **state)
{
    (void)state;
    int ends[2], status = -1;
    assert_int_equal(pipe(ends), 0);
    close(ends[0]);
    const pid_t child = fork();
    if (child == 0) {
        signal(SIGPIPE, SIG_DFL);
        progress_set_fd(ends[1]);
        progress_begin("render", 1);
        progress_add(1);
        progress_end();
        _exit(7);
    }
    close(ends[1]);
    waitpid(child, &status, 0);
    assert_true(WIFEXITED(status) && WEXITSTATUS(status) == 7);
}

#define in_fresh_folder(test) cmocka_unit_test_setup_teardown(test, fresh_folder, remove_folder)

int main(void)
{
    const struct CMUnitTest tests[] = {
        in_fresh_folder(the_name_holds_the_old_file_until_commit_and_the_new_one_after),
        in_fresh_folder(abandon_leaves_no_trace),
        in_fresh_folder(a_writer_killed_before_commit_leaves_the_old_file),
        in_fresh_folder(two_writers_of_one_name_do_not_mix),
        in_fresh_folder(a_full_device_is_an_error_and_keeps_the_old_file),
        in_fresh_folder(an_error_while_writing_is_not_forgotten_at_commit),
        in_fresh_folder(places_that_cannot_be_written_are_named),
        in_fresh_folder(commit_by_path_keeps_the_same_promises),
        in_fresh_folder(make_directories_makes_parents_and_minds_files),
        in_fresh_folder(whole_files_are_read_up_to_the_limit),
        in_fresh_folder(a_new_take_has_its_folders_and_manifest_and_nothing_to_solve),
        in_fresh_folder(equal_takes_have_equal_manifests),
        in_fresh_folder(every_piece_is_found_and_views_are_sorted),
        in_fresh_folder(a_tools_export_under_its_own_name_is_found),
        in_fresh_folder(cameras_may_be_one_file_and_a_second_mesh_is_warned_of),
        in_fresh_folder(two_views_of_one_stem_are_refused),
        in_fresh_folder(a_broken_manifest_and_a_missing_folder_are_named),
        in_fresh_folder(real_studios_open_as_takes),
        in_fresh_folder(a_line_of_the_log_stays_one_line),
        in_fresh_folder(progress_counts_from_all_threads_and_reports_begin_and_end),
        in_fresh_folder(a_reader_of_progress_that_went_away_does_not_end_the_work),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
