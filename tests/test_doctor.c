// tests/test_doctor.c - a machine that will fail is told so, by what and with which remedy; a sound one is left in peace.
//
// The machine is a folder that plays /sys, /proc and /dev.
#include "rigd/doctor.h"
#include "solver/take/atomic_file.h"

#include <ftw.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <cmocka.h>

static char root[300];
static struct config config;
static struct json *report;

static void put(const char *path, const char *text)
{
    char full[700];
    snprintf(full, sizeof(full), "%s%s", root, path);
    *strrchr(full, '/') = 0;
    assert_int_equal(make_directories(full), 0);
    full[strlen(full)] = '/';
    FILE *f = fopen(full, "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
}

// Body i (from 1) in port BUS-i, as device i.
static void plug(int bus, int i, const char *serial)
{
    char path[200], text[40];
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%d-%d/busnum", bus, i);
    snprintf(text, sizeof(text), "%d\n", bus);
    put(path, text);
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%d-%d/devnum", bus, i);
    snprintf(text, sizeof(text), "%d\n", i);
    put(path, text);
    snprintf(path, sizeof(path), "/sys/bus/usb/devices/%d-%d/serial", bus, i);
    put(path, serial);
    snprintf(path, sizeof(path), "/dev/bus/usb/%03d/%03d", bus, i);
    put(path, "");
}

static void holds(int pid, const char *name, const char *device)
{
    char path[200], link[700];
    snprintf(path, sizeof(path), "/proc/%d/comm", pid);
    put(path, name);
    snprintf(path, sizeof(path), "/proc/%d/fd/0", pid);
    put(path, ""); // for the folder
    snprintf(link, sizeof(link), "%s/proc/%d/fd/17", root, pid);
    assert_int_equal(symlink(device, link), 0);
}

static int remove_entry(const char *path, const struct stat *st, int type, struct FTW *where)
{
    (void)st, (void)type, (void)where;
    return remove(path);
}

// n bodies on n_buses controllers, as many on each.
static int set_up_machine(int n, int n_buses)
{
    const char *tmp = getenv("TMPDIR");
    snprintf(root, sizeof(root), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp");
    if (!mkdtemp(root))
        return -1;
    config = (struct config){ .objects_per_shot = 1, .raw_mb = 1, .free_space_mb = 1, .fetch_limit = 8, .n_cameras = n };
    config.camera = calloc((size_t)n, sizeof(*config.camera));
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "1000\n");
    for (int i = 0; i < n; i++) {
        struct config_camera *c = &config.camera[i];
        const int bus = 1 + i % n_buses, port = 1 + i / n_buses;
        char serial[40];
        snprintf(c->name, sizeof(c->name), "A%02d", i + 1);
        snprintf(c->port, sizeof(c->port), "usb:%d-%d", bus, port);
        snprintf(c->serial, sizeof(c->serial), "%d", 6001000 + i);
        c->controller = bus + 1; // as config.c numbers them
        snprintf(serial, sizeof(serial), "0000%d\n", 6001000 + i); // as USB says it
        plug(bus, port, serial);
    }
    return 0;
}

static void examine(void)
{
    json_free(report);
    report = doctor_examine(&config, root, root);
}

static void tear_down_machine(void)
{
    json_free(report);
    report = NULL;
    config_free(&config);
    assert_int_equal(nftw(root, remove_entry, 16, FTW_DEPTH | FTW_PHYS), 0);
}

// How many findings of that severity (NULL: any) are about this and say all that.
static int n_found(const char *severity, const char *about, const char *a, const char *b)
{
    int n = 0;
    for (int i = 0; i < json_length(report, "findings"); i++) {
        char path[40];
        const char *text = "", *of = "", *how = "";
        snprintf(path, sizeof(path), "findings.%d.text", i);
        json_get_string(report, path, &text);
        snprintf(path, sizeof(path), "findings.%d.about", i);
        json_get_string(report, path, &of);
        snprintf(path, sizeof(path), "findings.%d.severity", i);
        json_get_string(report, path, &how);
        n += (!severity || !strcmp(how, severity)) && !strcmp(of, about) && strstr(text, a) && strstr(text, b);
    }
    return n;
}

static bool healthy(void)
{
    bool b = false;
    assert_int_equal(json_get_bool(report, "healthy", &b), 0);
    return b;
}

static void a_sound_machine_is_healthy(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(24, 1), 0);
    holds(4711, "rigd-camera\n", "/dev/bus/usb/001/003"); // our own
    holds(4712, "bash\n", "/dev/pts/1");
    examine();
    assert_true(healthy());
    for (int i = 0; i < config.n_cameras; i++) {
        char about[40];
        snprintf(about, sizeof(about), "camera %s", config.camera[i].name);
        assert_int_equal(n_found(NULL, about, "", ""), 0);
    }
    assert_int_equal(n_found("info", "endpoints", "24 cameras, 96 of about 96", ""), 1);
    assert_int_equal(n_found("info", "usbfs", "1000", ""), 1);
    tear_down_machine();
}

static void too_many_cameras_on_one_controller_are_counted(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(30, 1), 0);
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "endpoints", "USB bus 1: 30 cameras take 120 endpoints", "move 6 cameras"), 1);
    tear_down_machine();
    assert_int_equal(set_up_machine(30, 2), 0);
    examine();
    assert_true(healthy());
    tear_down_machine();
}

static void the_kernels_16_mb_are_too_little_for_many_downloads(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(40, 5), 0);
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "16\n");
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "usbfs", "usbfs_memory_mb is 16, 40 parallel copies need 21", "echo 84 > /sys/module/usbcore/parameters/usbfs_memory_mb"), 1);
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "0\n"); // no limit
    examine();
    assert_true(healthy());
    config.fetch_limit = 2; // 10 at a time do with it
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "16\n");
    examine();
    assert_true(healthy());
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "");
    examine();
    assert_int_equal(n_found("warning", "usbfs", "cannot read", ""), 1);
    tear_down_machine();
}

static void who_holds_a_camera_is_named(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(3, 1), 0);
    holds(1234, "gvfs-gphoto2-vo\n", "/dev/bus/usb/001/002");
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "camera A02", "/dev/bus/usb/001/002 is held by gvfs-gphoto2-vo (process 1234)", "stop it"), 1);
    assert_int_equal(n_found(NULL, "camera A01", "", "") + n_found(NULL, "camera A03", "", ""), 0);
    tear_down_machine();
}

static void an_empty_port_and_the_wrong_body_are_told(void **state)
{
    (void)state;
    char full[700];
    assert_int_equal(set_up_machine(4, 1), 0);
    plug(1, 2, "0000004711\n");
    plug(1, 4, "1003\n"); // shorter than what is configured, though its end
    snprintf(full, sizeof(full), "%s/sys/bus/usb/devices/1-3/devnum", root);
    assert_int_equal(unlink(full), 0);
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "camera A02", "hangs serial 0000004711", "rigd.conf says 6001001"), 1);
    assert_int_equal(n_found("error", "camera A03", "nothing is plugged into its port usb:1-3", "check cable"), 1);
    assert_int_equal(n_found("error", "camera A04", "hangs serial 1003", ""), 1);
    assert_int_equal(n_found(NULL, "camera A01", "", ""), 0);
    tear_down_machine();
}

static void a_device_that_cannot_be_opened_names_the_rules(void **state)
{
    (void)state;
    char full[700];
    assert_int_equal(set_up_machine(2, 1), 0);
    snprintf(full, sizeof(full), "%s/dev/bus/usb/001/001", root);
    assert_int_equal(geteuid() ? chmod(full, 0400) : unlink(full), 0); // root may open everything that is there
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "camera A01", geteuid() ? "Permission denied" : "No such file", "udev rules"), 1);
    tear_down_machine();
}

static void plug_board(int port, const char *maker, const char *serial, const char *version)
{
    static const char *const names[] = { "idVendor", "idProduct", "manufacturer", "product", "serial", "bcdDevice", "busnum", "devnum" };
    char number[20], path[200], text[80];
    snprintf(number, sizeof(number), "%d", port);
    const char *const values[] = { "1209", "5247", maker, "trigger board", serial, version, "2", number };
    for (int i = 0; i < 8; i++) {
        snprintf(path, sizeof(path), "/sys/bus/usb/devices/2-%d/%s", port, names[i]);
        snprintf(text, sizeof(text), "%s\n", values[i]);
        put(path, text);
    }
    snprintf(path, sizeof(path), "/dev/bus/usb/002/%03d", port);
    put(path, "");
}

static void the_trigger_board_is_found_or_what_is_in_its_way(void **state)
{
    (void)state;
    char full[700];
    assert_int_equal(set_up_machine(1, 1), 0);
    plug_board(3, "somebody", "S1", "0100");
    examine();
    assert_int_equal(n_found(NULL, "trigger board", "", ""), 0); // nobody asked for one
    config.trigger.kind = TRIGGER_USB;
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "trigger board", "S1 (somebody trigger board) at 2-3", ""), 1);
    plug_board(4, "studiorig", "85323130", "0100");
    examine();
    assert_int_equal(n_found("info", "trigger board", "board 85323130 at USB 2-4", "protocol 1.0"), 1);
    assert_true(healthy());
    holds(1234, "another\n", "/dev/bus/usb/002/004");
    examine();
    assert_int_equal(n_found("error", "trigger board", "held by another (process 1234)", ""), 1);
    plug_board(5, "studiorig", "85323131", "0200");
    examine();
    assert_int_equal(n_found("error", "trigger board", "2 are plugged in", "[trigger] serial"), 1);
    strcpy(config.trigger.serial, "85323131");
    examine();
    assert_int_equal(n_found("error", "trigger board", "speaks protocol 2.0, this rigd 1.0", "flash"), 1);
    assert_int_equal(n_found(NULL, "trigger board", "", ""), 1);
    strcpy(config.trigger.serial, "4711");
    examine();
    assert_int_equal(n_found("error", "trigger board", "no board 4711", "correct [trigger] serial"), 1);
    strcpy(config.trigger.serial, "85323130");
    snprintf(full, sizeof(full), "%s/dev/bus/usb/002/004", root);
    assert_int_equal(geteuid() ? chmod(full, 0400) : unlink(full), 0);
    examine();
    assert_int_equal(n_found("error", "trigger board", "install rigd's udev rules", ""), 1);
    tear_down_machine();
}

static void a_disk_that_is_full_or_not_there_is_told(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(2, 1), 0);
    config.free_space_mb = 1000000000; // 1 PB
    examine();
    assert_false(healthy());
    assert_int_equal(n_found("error", "disk", "a take needs 2", "remove old takes"), 1);
    json_free(report);
    report = doctor_examine(&config, root, "/nowhere/takes");
    assert_false(healthy());
    assert_int_equal(n_found("error", "disk", "/nowhere/takes: No such file", "create it"), 1);
    tear_down_machine();
}

static void a_page_that_others_can_reach_is_told(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(1, 1), 0);
    examine();
    assert_int_equal(n_found(NULL, "page", "", ""), 0); // there is none
    static const char *const inside[] = { "127.0.0.1:8420", "127.1.2.3:1", "[::1]:8420" }, *const outside[] = { "0.0.0.0:8420", "192.168.1.5:8420", "[::]:8420", "[::2]:8420" };
    for (int i = 0; i < 3; i++) {
        strcpy(config.web.listen, inside[i]);
        examine();
        assert_int_equal(n_found("info", "page", inside[i], "nobody outside"), 1);
    }
    for (int i = 0; i < 4; i++) {
        strcpy(config.web.listen, outside[i]);
        strcpy(config.state_dir, "/var/lib/rigd");
        examine();
        assert_int_equal(n_found("warning", "page", outside[i], "/var/lib/rigd/web-token"), 1);
        assert_true(healthy()); // as it was configured
    }
    tear_down_machine();
}

static void this_machine_can_be_looked_at(void **state)
{
    (void)state;
    assert_int_equal(set_up_machine(1, 1), 0);
    strcpy(config.camera[0].port, "ptpip:127.0.0.1:15740:15741");
    config.camera[0].controller = 0;
    json_free(report);
    report = doctor_examine(&config, "", root);
    assert_int_equal(n_found(NULL, "clock", "synchronised", ""), 1);
    assert_int_equal(n_found(NULL, "usbfs", "", "") + n_found(NULL, "endpoints", "", ""), 0); // no USB camera
    config.n_cameras = CONFIG_CAMERAS_MAX; // no more than that are ever looked at
    config.camera = realloc(config.camera, CONFIG_CAMERAS_MAX * sizeof(*config.camera));
    for (int i = 1; i < CONFIG_CAMERAS_MAX; i++) {
        config.camera[i] = config.camera[0];
        snprintf(config.camera[i].port, sizeof(config.camera[i].port), "usb:9-%d", i);
        config.camera[i].controller = 9;
    }
    json_free(report);
    report = doctor_examine(&config, "", root);
    assert_false(healthy());
    tear_down_machine();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_sound_machine_is_healthy),
        cmocka_unit_test(too_many_cameras_on_one_controller_are_counted),
        cmocka_unit_test(the_kernels_16_mb_are_too_little_for_many_downloads),
        cmocka_unit_test(who_holds_a_camera_is_named),
        cmocka_unit_test(an_empty_port_and_the_wrong_body_are_told),
        cmocka_unit_test(a_device_that_cannot_be_opened_names_the_rules),
        cmocka_unit_test(the_trigger_board_is_found_or_what_is_in_its_way),
        cmocka_unit_test(a_disk_that_is_full_or_not_there_is_told),
        cmocka_unit_test(a_page_that_others_can_reach_is_told),
        cmocka_unit_test(this_machine_can_be_looked_at),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
