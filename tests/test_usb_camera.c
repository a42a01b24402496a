// tests/test_usb_camera.c - the real worker, the real libgphoto2 and the real libusb against a live USB camera behind umockdev: found by
// its slot, configured, released, emptied, pulled out, hung, killed. What PTP/IP cannot show (test_camera_worker.c) is here.
#include "rigd/camera.h"
#include "rigd/digest.h"
#include "rigd/doctor.h"
#include "tests/scratch.h"

#if !__has_include(<umockdev.h>) || defined(__SANITIZE_THREAD__)

int main(void)
{
    printf("1..0 # SKIP needs libumockdev-dev, and not the thread sanitizer, which does not know GLib's locks\n");
    return 0;
}

#else
#include "tests/usb/usb_camera.h"

#include <errno.h>
#include <fcntl.h>
#include <glob.h>
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>

static UMockdevTestbed *bed;
static struct scene *scene;
static struct personality *nikon, *generic;

static const char *no_name(unsigned camera)
{
    (void)camera;
    return "A01";
}

// ---- the camera --------------------------------------------------------------------------------------------------------------

static struct usb_camera *camera; // of the test that runs

static void plug_in(const struct personality *personality)
{
    assert_int_equal(usb_camera_new(&camera, bed, personality, scene), 0);
    assert_int_equal(usb_camera_plug(camera, 4), 0);
}

// libgphoto2 2.5.30 forgets the handle of a device that it could not claim, or that went away while it was open.
static void allow_leaks_of_the_driver(void)
{
    setenv("ASAN_OPTIONS", "detect_leaks=0", 1); // of programs started from here
}

static int unplug(void **state)
{
    (void)state;
    unsetenv("ASAN_OPTIONS");
    usb_camera_free(camera);
    camera = NULL;
    return 0;
}

// ---- a worker --------------------------------------------------------------------------------------------------------------

struct worker {
    pid_t pid;
    int fd;
    uint32_t seq;
    struct camera_event answer;
    int n_objects;
    struct camera_object object; // the last that was announced
};

static void hear(struct worker *w)
{
    static char text[CAMERA_MESSAGE_MAX];
    struct pollfd p = { .fd = w->fd, .events = POLLIN };
    int n_ready;
    while ((n_ready = poll(&p, 1, 180000)) < 0 && errno == EINTR)
        ;
    if (n_ready != 1)
        fail_msg("the worker hangs");
    const ssize_t n = recv(w->fd, text, sizeof(text), 0);
    if (n <= 0)
        fail_msg("the worker died");
    assert_int_equal(camera_event_decode(&w->answer, text, (size_t)n), 0);
}

static void worker_start(struct worker *w)
{
    int ends[2];
    char program[400];
    const char *folder = getenv("BIN");
    snprintf(program, sizeof(program), "%s/rigd-camera", folder ? folder : "build/bin");
    memset(w, 0, sizeof(*w));
    assert_int_equal(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends), 0);
    const int log = open("/dev/null", O_WRONLY | O_CLOEXEC); // umockdev's locks make open() unsafe after fork()
    w->pid = fork();
    assert_true(w->pid >= 0);
    if (!w->pid) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        if (ends[1] == CAMERA_FD)
            fcntl(CAMERA_FD, F_SETFD, 0);
        else
            dup2(ends[1], CAMERA_FD);
        if (!getenv("V"))
            dup2(log, 2); // the driver prints what it does not like
        execl(program, "rigd-camera", NULL);
        _exit(127);
    }
    close(log);
    close(ends[1]);
    w->fd = ends[0];
    hear(w);
    assert_int_equal(w->answer.kind, CAMERA_HELLO);
}

static void worker_stop(struct worker *w)
{
    int status;
    close(w->fd);
    assert_int_equal(waitpid(w->pid, &status, 0), w->pid);
    assert_true(WIFEXITED(status) && WEXITSTATUS(status) == 0);
}

static void send_command(struct worker *w, struct camera_command c)
{
    size_t n;
    c.seq = ++w->seq;
    c.timeout_ms = c.timeout_ms ? c.timeout_ms : 10000;
    char *text = camera_command_encode(&c, &n);
    assert_non_null(text);
    assert_int_equal(send(w->fd, text, n, MSG_NOSIGNAL), n);
    free(text);
}

static void hear_answer(struct worker *w)
{
    for (w->n_objects = 0;;) {
        hear(w);
        assert_int_equal(w->answer.seq, w->seq);
        if (w->answer.kind == CAMERA_DONE || w->answer.kind == CAMERA_FAILED)
            return;
        if (w->answer.kind == CAMERA_OBJECT) {
            w->n_objects++;
            w->object = w->answer.object[0];
        }
    }
}

static const struct camera_event *done(struct worker *w, struct camera_command c)
{
    send_command(w, c);
    hear_answer(w);
    if (w->answer.kind != CAMERA_DONE)
        fail_msg("%s: %s: %s", camera_command_name(c.kind), camera_trouble_name(w->answer.trouble), w->answer.text);
    return &w->answer;
}

static void expect_failure(struct worker *w, enum camera_trouble trouble, const char *words)
{
    hear_answer(w);
    if (w->answer.kind != CAMERA_FAILED || w->answer.trouble != trouble || !strstr(w->answer.text, words))
        fail_msg("expected %s (%s), found %s: %s", camera_trouble_name(trouble), words,
                 w->answer.kind == CAMERA_DONE ? "done" : camera_trouble_name(w->answer.trouble), w->answer.text);
    assert_true(w->answer.err < 0);
}

static void fails(struct worker *w, struct camera_command c, enum camera_trouble trouble, const char *words)
{
    send_command(w, c);
    expect_failure(w, trouble, words);
}

static struct camera_command plain(enum camera_command_kind kind)
{
    return (struct camera_command){ .kind = kind };
}

static struct camera_command opening(const char *conf)
{
    struct camera_command c = { .kind = CAMERA_OPEN, .port = "usb:" USB_CAMERA_SLOT };
    snprintf(c.personality, sizeof(c.personality), "config/cameras/%s.conf", conf);
    return c;
}

static struct camera_command fetching(enum camera_command_kind kind, const struct camera_object *o, const char *name)
{
    struct camera_command c = { .kind = kind, .object = *o };
    snprintf(c.path, sizeof(c.path), "%s", scratch_path(name));
    return c;
}

static struct camera_object shoot(struct worker *w)
{
    done(w, plain(CAMERA_TRIGGER));
    assert_int_equal(done(w, (struct camera_command){ .kind = CAMERA_COLLECT, .n_objects = 1 })->n_objects, 1);
    assert_int_equal(w->n_objects, 1);
    return w->object;
}

// The copy is the file that the body has on its card, byte for byte.
static void fetch_whole(struct worker *w, const struct camera_object *o)
{
    char hash[DIGEST_HEX], on_disk[DIGEST_HEX];
    int64_t size, size_on_disk;
    assert_int_equal(usb_camera_digest(camera, o->name, hash, &size), 0);
    const struct camera_event *e = done(w, fetching(CAMERA_FETCH, o, "A01.dng"));
    assert_string_equal(e->xxh128, hash);
    assert_int_equal(e->size_bytes, size);
    assert_int_equal(digest_file(scratch_path("A01.dng"), 0, on_disk, &size_on_disk), 0);
    assert_string_equal(on_disk, hash);
    assert_int_equal(size_on_disk, size);
    unlink(scratch_path("A01.dng"));
}

static void assert_nothing_is_left(void)
{
    assert_int_equal(rmdir(scratch_dir), 0); // hidden names count
    assert_int_equal(mkdir(scratch_dir, 0700), 0);
}

// ---- promises ----------------------------------------------------------------------------------------------------------------

static void a_frame_comes_from_release_to_disk_over_usb(void **state)
{
    (void)state;
    plug_in(nikon);
    struct worker w;
    worker_start(&w);
    const struct camera_event *e = done(&w, opening("nikon"));
    assert_string_equal(e->facts.driver_port, "usb:001,004");
    assert_string_equal(e->facts.serial, nikon->serial);
    assert_string_equal(e->facts.model, nikon->model);
    e = done(&w, plain(CAMERA_STATUS));
    assert_int_equal(e->status.battery_percent, 100);
    assert_int_equal(e->status.card_present, 1);
    assert_true(e->status.clock_offset_s > -60 && e->status.clock_offset_s < 60);
    const struct camera_command c = { .kind = CAMERA_CONFIGURE, .n_settings = 2, .setting = { { "iso", "400" }, { "shutter", "1/250" } } };
    for (int time = 0; time < 2; time++) {
        e = done(&w, c);
        for (int i = 0; i < 2; i++)
            assert_true(e->setting[i].equal && e->setting[i].written == !time);
    }
    done(&w, (struct camera_command){ .kind = CAMERA_DRAIN, .quiet_ms = 50 });
    const struct camera_object o = shoot(&w);
    fetch_whole(&w, &o);
    assert_true(usb_camera_counts(camera).urb_bytes_max <= (512 + 16) << 10); // doctor.c counts with that
    done(&w, fetching(CAMERA_THUMBNAIL, &o, "A01.jpg"));
    unlink(scratch_path("A01.jpg"));
    done(&w, plain(CAMERA_CLOSE));
    worker_stop(&w);
}

static void events_of_the_interrupt_endpoint_are_heard(void **state)
{
    (void)state;
    plug_in(generic);
    struct worker w;
    worker_start(&w);
    done(&w, opening("generic"));
    assert_int_equal(usb_camera_counts(camera).n_interrupts, 0);
    const struct camera_object o = shoot(&w);
    assert_true(usb_camera_counts(camera).n_interrupts >= 1);
    fetch_whole(&w, &o);
    worker_stop(&w);
}

static void pulled_out_in_a_download_nothing_is_half_there_and_the_frame_comes_after_replugging(void **state)
{
    (void)state;
    allow_leaks_of_the_driver();
    plug_in(nikon);
    struct worker w;
    worker_start(&w);
    done(&w, opening("nikon"));
    const struct camera_object o = shoot(&w);
    usb_camera_pause_after(camera, 1 << 20);
    send_command(&w, fetching(CAMERA_FETCH, &o, "A01.dng"));
    assert_true(usb_camera_wait_paused(camera, 60000));
    usb_camera_unplug(camera);
    expect_failure(&w, CAMERA_LOST, "cable");
    assert_nothing_is_left();
    fails(&w, opening("nikon"), CAMERA_LOST, "nothing is plugged in at");
    assert_int_equal(usb_camera_plug(camera, 5), 0); // the slot is the same, its number another
    assert_string_equal(done(&w, opening("nikon"))->facts.driver_port, "usb:001,005");
    fetch_whole(&w, &o);
    worker_stop(&w);
}

static void a_stuck_body_is_named_and_a_bus_reset_brings_it_back(void **state)
{
    (void)state;
    plug_in(nikon);
    struct worker w;
    worker_start(&w);
    done(&w, opening("nikon"));
    const struct camera_object o = shoot(&w);
    struct camera_command status = plain(CAMERA_STATUS), open = opening("nikon");
    status.timeout_ms = 2300; // the shortest time after which the driver's silence is told from a broken link
    open.reset = true;
    usb_camera_hang(camera);
    fails(&w, status, CAMERA_STALLED, "no answer");
    assert_int_equal(usb_camera_counts(camera).n_resets, 0);
    done(&w, open);
    assert_int_equal(usb_camera_counts(camera).n_resets, 1);
    fetch_whole(&w, &o);
    worker_stop(&w);
}

static void after_a_killed_worker_the_next_one_fetches_the_frame(void **state)
{
    (void)state;
    plug_in(nikon);
    struct worker w;
    worker_start(&w);
    done(&w, opening("nikon"));
    const struct camera_object o = shoot(&w);
    usb_camera_pause_after(camera, 1 << 20);
    send_command(&w, fetching(CAMERA_FETCH, &o, "A01.dng"));
    assert_true(usb_camera_wait_paused(camera, 60000));
    kill(w.pid, SIGKILL);
    waitpid(w.pid, NULL, 0);
    close(w.fd);
    assert_int_not_equal(access(scratch_path("A01.dng"), F_OK), 0);
    usb_camera_resume(camera);
    worker_start(&w);
    done(&w, opening("nikon"));
    fetch_whole(&w, &o);
    worker_stop(&w);
}

// How many descriptors the worker has on USB devices.
static int open_devices(const struct worker *w)
{
    char name[64], target[600];
    int n = 0;
    for (int fd = 0; fd < 256; fd++) {
        snprintf(name, sizeof(name), "/proc/%d/fd/%d", (int)w->pid, fd);
        const ssize_t length = readlink(name, target, sizeof(target) - 1);
        target[length > 0 ? length : 0] = 0;
        n += strstr(target, "/dev/bus/usb/") != NULL;
    }
    return n;
}

static void a_camera_that_another_program_holds_is_said_to_be_held(void **state)
{
    (void)state;
    allow_leaks_of_the_driver();
    plug_in(nikon);
    struct worker first, second;
    worker_start(&first);
    worker_start(&second);
    done(&first, opening("nikon"));
    fails(&second, opening("nikon"), CAMERA_LOST, "another program holds");
    assert_int_equal(second.answer.err, -EBUSY);
    assert_true(open_devices(&first) > 0);
    assert_int_equal(open_devices(&second), 0); // a retry a minute would use up all descriptors
    done(&first, plain(CAMERA_CLOSE));
    done(&second, opening("nikon"));
    worker_stop(&first);
    worker_stop(&second);
}

static void stock_gphoto2_finds_it_and_captures(void **state)
{
    (void)state;
    char command[1600], line[300], hash[DIGEST_HEX], on_disk[DIGEST_HEX];
    int64_t size, size_on_disk;
    bool listed = false;
    if (system("command -v gphoto2 >/dev/null")) {
        print_message("gphoto2 is not installed: not checked\n");
        return;
    }
    allow_leaks_of_the_driver();
    plug_in(nikon);
    FILE *f = popen("HOME=/nonexistent LC_ALL=C gphoto2 --auto-detect 2>&1", "r");
    assert_non_null(f);
    while (fgets(line, sizeof(line), f))
        listed |= strstr(line, "Nikon DSC D500") && strstr(line, "usb:001,004");
    assert_int_equal(pclose(f), 0);
    assert_true(listed);
    snprintf(command, sizeof(command), "HOME=/nonexistent gphoto2 --port usb:001,004 --set-config capturetarget=1 --filename '%s' --keep --trigger-capture --wait-event-and-download=FILEADDED >/dev/null 2>&1",
             scratch_path("stock.dng"));
    assert_int_equal(system(command), 0);
    assert_int_equal(usb_camera_digest(camera, "DSC_0001.DNG", hash, &size), 0);
    assert_int_equal(digest_file(scratch_path("stock.dng"), 0, on_disk, &size_on_disk), 0);
    assert_string_equal(on_disk, hash);
    unlink(scratch_path("stock.dng"));
}

// One program after the other as a user starts them, with the cable pulled in the middle of the download.
static void a_take_of_the_daemon_survives_a_pulled_cable(void **state)
{
    (void)state;
    char command[1600], hash[DIGEST_HEX], on_disk[DIGEST_HEX], pattern[700], here[300];
    const char *folder = getenv("BIN") ? getenv("BIN") : "build/bin";
    int64_t size, size_on_disk;
    int status;
    allow_leaks_of_the_driver();
    assert_non_null(getcwd(here, sizeof(here)));
    plug_in(nikon);
    FILE *f = fopen(scratch_path("rigd.conf"), "w");
    assert_non_null(f);
    fprintf(f, "[rig]\ntakes = %s/takes\nstate = %s/takes\nsocket = %s/s\npersonality_dir = %s/config/cameras\nraw_mb = 2\nfree_space_mb = 1\nthumbnails = no\n[trigger]\nkind = software\n"
               "[camera \"A01\"]\nserial = %s\nport = usb:%s\npersonality = nikon\n",
            scratch_dir, scratch_dir, scratch_dir, here, nikon->serial, USB_CAMERA_SLOT);
    assert_int_equal(fclose(f), 0);
    snprintf(command, sizeof(command), "exec %s/rigd --config '%s' --once >'%s' 2>&1", folder, scratch_path("rigd.conf"), scratch_path("log"));
    usb_camera_pause_after(camera, 1 << 20);
    const pid_t pid = fork();
    assert_true(pid >= 0);
    if (!pid) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        execl("/bin/sh", "sh", "-c", command, NULL);
        _exit(127);
    }
    const bool is_halfway = usb_camera_wait_paused(camera, 120000);
    if (is_halfway) {
        usb_camera_unplug(camera);
        assert_int_equal(usb_camera_plug(camera, 5), 0);
    } else {
        kill(pid, SIGTERM);
    }
    assert_int_equal(waitpid(pid, &status, 0), pid);
    if (!is_halfway || status) {
        snprintf(command, sizeof(command), "tail -20 '%s' >&2", scratch_path("log"));
        status = system(command) | 1;
    }
    assert_int_equal(status, 0);
    assert_int_equal(usb_camera_digest(camera, "DSC_0001.DNG", hash, &size), 0);
    snprintf(pattern, sizeof(pattern), "%s/takes/*/*/A01*", scratch_dir);
    glob_t found;
    assert_int_equal(glob(pattern, 0, NULL, &found), 0);
    assert_int_equal(found.gl_pathc, 1);
    assert_int_equal(digest_file(found.gl_pathv[0], 0, on_disk, &size_on_disk), 0);
    assert_string_equal(on_disk, hash);
    globfree(&found);
    snprintf(command, sizeof(command), "rm -r '%s'", scratch_path("takes"));
    assert_int_equal(system(command), 0);
    scratch_empty();
}

static void assert_finding(const struct json *report, const char *about, const char *severity, const char *words)
{
    const int n = json_length(report, "findings");
    for (int i = 0; i < n; i++) {
        const char *found, *level, *text;
        char key[40];
        snprintf(key, sizeof(key), "findings.%d", i);
        const struct json *o = json_get(report, key);
        assert_int_equal(json_get_string(o, "about", &found), 0);
        assert_int_equal(json_get_string(o, "severity", &level), 0);
        assert_int_equal(json_get_string(o, "text", &text), 0);
        if (strcmp(found, about))
            continue;
        if (strcmp(level, severity) || !strstr(text, words))
            fail_msg("%s: expected %s '%s', found %s: %s", about, severity, words, level, text);
        return;
    }
    fail_msg("doctor says nothing about %s", about);
}

// The same 30 slots as the kernel shows them, one of them empty.
static void doctor_warns_of_thirty_cameras_on_one_controller(void **state)
{
    (void)state;
    enum { N = 30 };
    char *root = umockdev_testbed_get_root_dir(bed), path[600];
    FILE *f = fopen(scratch_path("rigd.conf"), "w");
    assert_non_null(f);
    fprintf(f, "[rig]\nname = R\ntakes = %s\nfetch_limit = 30\n[trigger]\nkind = software\n", scratch_dir);
    for (int i = 1; i <= N; i++) {
        char name[40], bus[8] = "7", number[8], serial[16];
        snprintf(name, sizeof(name), "7-%d.%d", i / 8 + 1, i % 8 + 1);
        snprintf(number, sizeof(number), "%d", 10 + i);
        snprintf(serial, sizeof(serial), "%d", 6001000 + i);
        fprintf(f, "[camera \"A%02d\"]\nserial = %s\nport = usb:%s\n", i, serial, name);
        if (i == 9)
            continue;
        char *device = umockdev_testbed_add_device(bed, "usb", name, NULL, "busnum", bus, "devnum", number, "serial", i == 12 ? "4711" : serial, NULL,
                                                   "DEVTYPE", "usb_device", NULL);
        assert_non_null(device);
        g_free(device);
    }
    fclose(f);
    snprintf(path, sizeof(path), "%s/sys/module/usbcore/parameters", root);
    assert_int_equal(g_mkdir_with_parents(path, 0755), 0);
    snprintf(path, sizeof(path), "%s/sys/module/usbcore/parameters/usbfs_memory_mb", root);
    struct config config;
    assert_int_equal(config_read(&config, scratch_path("rigd.conf")), 0);
    for (int mb = 15; mb <= 16; mb++) { // half a megabyte each, and a little
        char *text = g_strdup_printf("%d\n", mb);
        assert_true(g_file_set_contents(path, text, -1, NULL));
        g_free(text);
        struct json *report = doctor_examine(&config, root, scratch_dir);
        bool is_healthy = true;
        assert_int_equal(json_get_bool(report, "healthy", &is_healthy), 0);
        assert_false(is_healthy);
        assert_finding(report, "endpoints", "error", "USB bus 7: 30 cameras take 120 endpoints");
        assert_finding(report, "usbfs", mb < 16 ? "error" : "info", mb < 16 ? "usbfs_memory_mb is 15, 30 parallel copies need 16" : "16");
        assert_finding(report, "camera A09", "error", "nothing is plugged into its port usb:");
        assert_finding(report, "camera A12", "error", "hangs serial 4711");
        json_free(report);
    }
    config_free(&config);
    g_free(root);
    unlink(scratch_path("rigd.conf"));
}

// It finds a host that dies within a request worth a word.
static void ignore(const gchar *domain, GLogLevelFlags level, const gchar *text, gpointer arg)
{
    (void)domain, (void)level, (void)text, (void)arg;
}

int main(int argc, char **argv)
{
    (void)argc;
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_teardown(a_frame_comes_from_release_to_disk_over_usb, unplug),
        cmocka_unit_test_teardown(events_of_the_interrupt_endpoint_are_heard, unplug),
        cmocka_unit_test_teardown(pulled_out_in_a_download_nothing_is_half_there_and_the_frame_comes_after_replugging, unplug),
        cmocka_unit_test_teardown(a_stuck_body_is_named_and_a_bus_reset_brings_it_back, unplug),
        cmocka_unit_test_teardown(after_a_killed_worker_the_next_one_fetches_the_frame, unplug),
        cmocka_unit_test_teardown(a_camera_that_another_program_holds_is_said_to_be_held, unplug),
        cmocka_unit_test_teardown(stock_gphoto2_finds_it_and_captures, unplug),
        cmocka_unit_test_teardown(a_take_of_the_daemon_survives_a_pulled_cable, unplug),
        cmocka_unit_test_teardown(doctor_warns_of_thirty_cameras_on_one_controller, unplug),
    };
    usbfs_preload(argv);
    nikon = malloc(sizeof(*nikon));
    generic = malloc(sizeof(*generic));
    bed = umockdev_testbed_new();
    g_log_set_handler(NULL, G_LOG_LEVEL_CRITICAL, ignore, NULL);
    if (!umockdev_in_mock_environment()) {
        printf("1..0 # SKIP umockdev's library cannot be preloaded here (under a sanitizer that is linked statically?)\n");
        return 0;
    }
    if (!nikon || !generic || personality_load(nikon, "nikon") || personality_load(generic, "generic") || scene_open(&scene, NULL, 1224, 816, 1, no_name) || scratch_open())
        return 1;
    const int failed = cmocka_run_group_tests_name("usb_camera", tests, NULL, NULL);
    scratch_empty();
    scene_close(scene);
    g_object_unref(bed);
    free(nikon);
    free(generic);
    return scratch_close() ? 1 : failed;
}
#endif
