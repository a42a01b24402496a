// tests/test_ingest.c - a frame is whole under its name or has none: killed at every call, power cut, full and failing disks.
// The calls that make a copy durable are defined here and count, fail or kill as a test wants; the linker prefers them to libc's.
#include "rigd/ingest.h"
#include "tests/scratch.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdbool.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>

enum { SIZE = 700001, PIECE = 65536 }; // 11 pieces, the last one short

// Shared with the child that is killed: what of its work is on the disk for certain.
struct disk {
    int step;          // calls so far
    int kill_at;       // step at which the process dies, 0: never
    bool kill_after;   // after the call did its work, not before
    int fail_at, fail; // step and errno
    int64_t written, synced; // bytes of the part
    bool renamed, folder_synced;
    bool short_writes, flip_a_bit, no_noreplace;
    int interrupted;   // writes to come that EINTR ends
};
static struct disk *disk;

static bool on_step(void)
{
    disk->step++;
    if (disk->step == disk->kill_at && !disk->kill_after)
        raise(SIGKILL);
    if (disk->step == disk->fail_at) {
        errno = disk->fail;
        return false;
    }
    return true;
}

static void after_step(void)
{
    if (disk->step == disk->kill_at)
        raise(SIGKILL);
}

ssize_t write(int fd, const void *bytes, size_t n)
{
    if (fd <= 2)
        return syscall(SYS_write, fd, bytes, n);
    if (disk->interrupted > 0) {
        disk->interrupted--;
        errno = EINTR;
        return -1;
    }
    if (!on_step())
        return -1;
    const ssize_t wrote = syscall(SYS_write, fd, bytes, disk->short_writes && n > 1 ? 1 + n / 3 : n);
    disk->written += wrote > 0 ? wrote : 0;
    after_step();
    return wrote;
}

int fsync(int fd)
{
    struct stat st;
    if (!on_step())
        return -1;
    const int result = (int)syscall(SYS_fsync, fd);
    if (!result && !fstat(fd, &st)) {
        if (S_ISDIR(st.st_mode))
            disk->folder_synced = disk->renamed;
        else
            disk->synced = disk->written;
    }
    after_step();
    return result;
}

int renameat2(int from_dir, const char *from, int to_dir, const char *to, unsigned flags)
{
    if (disk->no_noreplace) {
        errno = EINVAL;
        return -1;
    }
    if (!on_step())
        return -1;
    const int result = (int)syscall(SYS_renameat2, from_dir, from, to_dir, to, flags);
    disk->renamed |= !result;
    after_step();
    return result;
}

ssize_t read(int fd, void *bytes, size_t n)
{
    const ssize_t got = syscall(SYS_read, fd, bytes, n);
    if (disk->flip_a_bit && got > 100) {
        disk->flip_a_bit = false;
        ((char *)bytes)[99] ^= 4;
    }
    return got;
}

// ---- a frame ---------------------------------------------------------------------------------------------------------------

static unsigned char frame[SIZE];
static char frame_hash[DIGEST_HEX];

static void start_over(void)
{
    char *names[] = { "A01.dng", "A01.dng.part" };
    for (int i = 0; i < 2; i++)
        unlink(scratch_path(names[i]));
    memset(disk, 0, sizeof(*disk));
}

static int copy_frame(char hash[DIGEST_HEX], int64_t *size)
{
    struct ingest *s;
    int err = ingest_begin(&s, scratch_path("A01.dng"));
    if (err)
        return err;
    for (size_t at = 0; at < SIZE && !err; at += PIECE)
        err = ingest_write(s, frame + at, SIZE - at < PIECE ? SIZE - at : PIECE);
    if (err) {
        ingest_abort(s);
        return err;
    }
    return ingest_finish(s, hash, size);
}

static bool is_there(const char *name)
{
    return !access(scratch_path(name), F_OK);
}

static void assert_whole(void)
{
    static unsigned char found[SIZE + 1];
    const int fd = open(scratch_path("A01.dng"), O_RDONLY);
    assert_true(fd >= 0);
    assert_int_equal(pread(fd, found, sizeof(found), 0), SIZE);
    close(fd);
    assert_memory_equal(found, frame, SIZE);
}

static void assert_copied(void)
{
    char hash[DIGEST_HEX];
    int64_t size = 0;
    assert_int_equal(copy_frame(hash, &size), 0);
    assert_string_equal(hash, frame_hash);
    assert_int_equal(size, SIZE);
    assert_whole();
    assert_false(is_there("A01.dng.part"));
}

static void a_copy_is_whole_hashed_and_durable(void **state)
{
    (void)state;
    start_over();
    assert_copied();
    assert_int_equal(disk->synced, SIZE);
    assert_true(disk->folder_synced);
}

// Runs the copy in a child that dies at that step. false: it got to its end.
static bool copy_killed(int step, bool after)
{
    disk->kill_at = step;
    disk->kill_after = after;
    const pid_t child = fork();
    assert_true(child >= 0);
    if (!child) {
        char hash[DIGEST_HEX];
        int64_t size;
        _exit(copy_frame(hash, &size) ? 1 : 0);
    }
    int status;
    assert_int_equal(waitpid(child, &status, 0), child);
    if (WIFEXITED(status)) {
        assert_int_equal(WEXITSTATUS(status), 0);
        return false;
    }
    assert_int_equal(WTERMSIG(status), SIGKILL);
    disk->kill_at = 0;
    return true;
}

// What a cut of power may do on top: everything that was not synced becomes zeros, or is cut off.
static void cut_power(bool zeros)
{
    const char *name = disk->renamed ? "A01.dng" : "A01.dng.part";
    const int fd = open(scratch_path(name), O_RDWR);
    if (fd < 0)
        return;
    struct stat st;
    assert_int_equal(fstat(fd, &st), 0);
    if (disk->synced < st.st_size) {
        assert_int_equal(ftruncate(fd, disk->synced), 0);
        if (zeros)
            assert_int_equal(ftruncate(fd, st.st_size), 0);
    }
    close(fd);
}

static void killed_at_any_call_it_is_whole_or_has_no_name(void **state)
{
    (void)state;
    int n = 0, n_named = 0;
    for (int power = 0; power < 3; power++) // alive, cut and shortened, cut and zeros
        for (int after = 0; after < 2; after++)
            for (int step = 1;; step++) {
                start_over();
                if (!copy_killed(step, after))
                    break;
                n++;
                if (power)
                    cut_power(power == 2);
                const bool named = is_there("A01.dng");
                n_named += named;
                if (named) {
                    assert_whole();
                    char hash[DIGEST_HEX];
                    int64_t size;
                    memset(disk, 0, sizeof(*disk));
                    assert_int_equal(ingest_adopt(scratch_path("A01.dng"), hash, &size), 0);
                    assert_string_equal(hash, frame_hash);
                } else {
                    memset(disk, 0, sizeof(*disk));
                    assert_copied(); // over what is left
                }
            }
    assert_true(n >= 3 * 2 * 14); // 11 writes, 2 syncs, 1 rename
    assert_true(n_named >= 3 * 3); // after the rename, before and after the folder's sync
    assert_true(n_named < n / 2);
}

static void a_failing_disk_is_told_and_leaves_nothing(void **state)
{
    (void)state;
    const int errors[] = { ENOSPC, EIO, EDQUOT };
    char hash[DIGEST_HEX];
    int64_t size;
    for (int e = 0; e < 3; e++)
        for (int step = 1;; step++) {
            start_over();
            disk->fail_at = step;
            disk->fail = errors[e];
            const int err = copy_frame(hash, &size);
            if (!err) {
                assert_true(step >= 14);
                break;
            }
            assert_int_equal(err, -errors[e]);
            assert_false(is_there("A01.dng.part"));
            if (is_there("A01.dng")) {
                assert_true(disk->renamed); // only the folder's sync failed: it is whole, and the next try takes it
                assert_whole();
            }
        }
}

static void short_and_interrupted_writes_lose_nothing(void **state)
{
    (void)state;
    start_over();
    disk->short_writes = true;
    disk->interrupted = 3;
    assert_copied();
}

static void a_disk_that_reads_back_differently_gets_no_name(void **state)
{
    (void)state;
    char hash[DIGEST_HEX];
    int64_t size;
    start_over();
    disk->flip_a_bit = true;
    assert_int_equal(copy_frame(hash, &size), -EBADMSG);
    assert_false(is_there("A01.dng"));
    assert_false(is_there("A01.dng.part"));
}

static void nothing_is_ever_replaced(void **state)
{
    (void)state;
    struct ingest *s;
    char hash[DIGEST_HEX], mine[4] = "";
    int64_t size;
    for (int no_noreplace = 0; no_noreplace < 2; no_noreplace++) {
        start_over();
        disk->no_noreplace = no_noreplace;
        assert_int_equal(ingest_begin(&s, scratch_path("A01.dng")), 0);
        assert_int_equal(ingest_write(s, frame, SIZE), 0);
        scratch_write("A01.dng", "old", 3); // while the copy is under way
        assert_int_equal(ingest_finish(s, hash, &size), -EEXIST);
        assert_int_equal(ingest_begin(&s, scratch_path("A01.dng")), -EEXIST);
        const int fd = open(scratch_path("A01.dng"), O_RDONLY);
        assert_int_equal(pread(fd, mine, 4, 0), 3);
        close(fd);
        assert_string_equal(mine, "old");
        assert_false(is_there("A01.dng.part"));
    }
}

static void file_systems_that_cannot_rename_without_replacing_do_it_by_a_link(void **state)
{
    (void)state;
    start_over();
    disk->no_noreplace = true;
    assert_copied();
}

static void what_a_dead_process_left_is_written_over(void **state)
{
    (void)state;
    start_over();
    static const char junk[2 * SIZE];
    scratch_write("A01.dng.part", junk, sizeof(junk)); // longer than the frame
    assert_copied();
}

static void paths_that_cannot_be_are_refused(void **state)
{
    (void)state;
    struct ingest *s;
    char hash[DIGEST_HEX], long_name[5000];
    int64_t size;
    start_over();
    assert_int_equal(ingest_begin(&s, scratch_path("no/such/folder.dng")), -ENOENT);
    assert_null(s);
    assert_int_equal(ingest_adopt(scratch_path("A01.dng"), hash, &size), -ENOENT);
    memset(long_name, 'x', sizeof(long_name) - 1);
    long_name[0] = '/', long_name[sizeof(long_name) - 1] = 0;
    assert_int_equal(ingest_begin(&s, long_name), -ENAMETOOLONG);
    ingest_abort(NULL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_copy_is_whole_hashed_and_durable),
        cmocka_unit_test(killed_at_any_call_it_is_whole_or_has_no_name),
        cmocka_unit_test(a_failing_disk_is_told_and_leaves_nothing),
        cmocka_unit_test(short_and_interrupted_writes_lose_nothing),
        cmocka_unit_test(a_disk_that_reads_back_differently_gets_no_name),
        cmocka_unit_test(nothing_is_ever_replaced),
        cmocka_unit_test(file_systems_that_cannot_rename_without_replacing_do_it_by_a_link),
        cmocka_unit_test(what_a_dead_process_left_is_written_over),
        cmocka_unit_test(paths_that_cannot_be_are_refused),
    };
    disk = mmap(NULL, sizeof(*disk), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (disk == MAP_FAILED || scratch_open())
        return 1;
    for (size_t i = 0; i < SIZE; i++)
        frame[i] = (unsigned char)(i * 2654435761u >> 13 | 1); // never a zero: a torn frame cannot look whole
    struct digest *d = digest_begin();
    digest_add(d, frame, SIZE);
    digest_end(d, frame_hash);
    const int failed = cmocka_run_group_tests_name("ingest", tests, NULL, NULL);
    start_over();
    scratch_close();
    return failed;
}
