// rigd/manifest.c - ASC MHL v2 written and checked by hand: the format is small, and only our own files are read back.
//
// A generation is written before the chain names it; one that the chain does not name was never handed over and is removed by the next.
#include "rigd/manifest.h"
#include "rigd/digest.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { DEPTH_MAX = 16, FILES_MAX = 1000000, MANIFEST_BYTES_MAX = 256 << 20 };

struct file {
    char *path; // relative
    char xxh128[DIGEST_HEX];
    int64_t size_bytes, modified_s;
    const char *action;
};

struct files {
    int n, room;
    struct file *file;
};

static const char *const ignored[] = { ".DS_Store", "ascmhl", "ascmhl/", "take.json", "processing.json", "log", "log/", "*.part" };

static void files_free(struct files *f)
{
    for (int i = 0; i < f->n; i++)
        free(f->file[i].path);
    free(f->file);
    *f = (struct files){ 0 };
}

static struct file *add_file(struct files *f, char *path) // takes path
{
    if (f->n == f->room) {
        const int room = f->room ? 2 * f->room : 64;
        struct file *grown = path && f->n < FILES_MAX ? realloc(f->file, (size_t)room * sizeof(*grown)) : NULL;
        if (!grown) {
            free(path);
            return NULL;
        }
        f->file = grown;
        f->room = room;
    }
    f->file[f->n] = (struct file){ .path = path };
    return path ? &f->file[f->n++] : NULL;
}

static int by_path(const void *a, const void *b)
{
    return strcmp(((const struct file *)a)->path, ((const struct file *)b)->path);
}

static struct file *find(const struct files *f, const char *path)
{
    const struct file key = { .path = (char *)(uintptr_t)path };
    return f->n ? bsearch(&key, f->file, (size_t)f->n, sizeof(key), by_path) : NULL;
}

static int walk(struct files *f, const char *dir, const char *relative, int depth)
{
    int err = 0;
    char *path = NULL;
    if (asprintf(&path, "%s%s%s", dir, relative[0] ? "/" : "", relative) < 0)
        return -ENOMEM;
    DIR *d = opendir(path);
    free(path);
    if (!d)
        return -errno;
    for (const struct dirent *e; !err && (e = readdir(d));) {
        struct stat st;
        char *name = NULL;
        const size_t length = strlen(e->d_name);
        if (e->d_name[0] == '.' || (length > 5 && !strcmp(e->d_name + length - 5, ".part")) || (!relative[0] && (!strcmp(e->d_name, "ascmhl") || !strcmp(e->d_name, "take.json") || !strcmp(e->d_name, "processing.json") || !strcmp(e->d_name, "log"))))
            continue;
        if (asprintf(&name, "%s%s%s", relative, relative[0] ? "/" : "", e->d_name) < 0) {
            err = -ENOMEM;
            break;
        }
        if (fstatat(dirfd(d), e->d_name, &st, AT_SYMLINK_NOFOLLOW)) {
            err = -errno;
        } else if (S_ISDIR(st.st_mode)) {
            err = depth < DEPTH_MAX ? walk(f, dir, name, depth + 1) : -ELOOP;
        } else if (S_ISREG(st.st_mode)) {
            struct file *added = add_file(f, name);
            name = NULL;
            if (!added) {
                err = -ENOMEM;
                break;
            }
            added->size_bytes = st.st_size;
            added->modified_s = st.st_mtime;
        }
        free(name);
    }
    closedir(d);
    return err;
}

// ---- text -----------------------------------------------------------------------------------------------------------------------

static void put_text(FILE *out, const char *s)
{
    for (; *s; s++)
        switch (*s) {
        case '&': fputs("&amp;", out); break;
        case '<': fputs("&lt;", out); break;
        case '>': fputs("&gt;", out); break;
        case '"': fputs("&quot;", out); break;
        default:
            fputc((unsigned char)*s < 0x20 ? '?' : *s, out);
        }
}

static void put_time(FILE *out, int64_t utc_s, const char *format)
{
    char text[40];
    struct tm tm;
    const time_t t = (time_t)utc_s;
    gmtime_r(&t, &tm);
    strftime(text, sizeof(text), format, &tm);
    fputs(text, out);
}

#define ISO "%Y-%m-%dT%H:%M:%S+00:00"

// The text between `<tag ...>` and `</tag>` from *at on, unescaped and malloc'd; *at moves behind it. Attributes begin at *attributes.
static char *element(const char **at, const char *end, const char *tag, const char **attributes)
{
    char open[40], close[40];
    snprintf(open, sizeof(open), "<%s", tag);
    snprintf(close, sizeof(close), "</%s>", tag);
    const char *s = *at;
    do {
        s = memmem(s, (size_t)(end - s), open, strlen(open));
        if (!s)
            return NULL;
        s += strlen(open);
    } while (s < end && *s != '>' && *s != ' ');
    *attributes = s;
    s = memchr(s, '>', (size_t)(end - s));
    const char *stop = s ? memmem(s, (size_t)(end - s), close, strlen(close)) : NULL;
    if (!stop)
        return NULL;
    *at = stop + strlen(close);
    char *text = malloc((size_t)(stop - s)), *o = text;
    for (s++; text && s < stop;) {
        static const char *const entities[][2] = { { "&amp;", "&" }, { "&lt;", "<" }, { "&gt;", ">" }, { "&quot;", "\"" }, { "&apos;", "'" } };
        size_t used = 0;
        for (int i = 0; *s == '&' && i < 5 && !used; i++)
            if ((size_t)(stop - s) >= strlen(entities[i][0]) && !strncmp(s, entities[i][0], strlen(entities[i][0]))) {
                *o++ = entities[i][1][0];
                used = strlen(entities[i][0]);
            }
        if (!used)
            *o++ = *s, used = 1;
        s += used;
    }
    if (text)
        *o = 0;
    return text;
}

// ---- what is there already ------------------------------------------------------------------------------------------------------

struct generation {
    char *name, *c4;
};

struct chain {
    int n;
    struct generation *generation;
};

static void chain_free(struct chain *c)
{
    for (int i = 0; i < c->n; i++) {
        free(c->generation[i].name);
        free(c->generation[i].c4);
    }
    free(c->generation);
    *c = (struct chain){ 0 };
}

static int broken(const char *path, const char *expected)
{
    log_error("manifest: %s: expected %s; move the ascmhl folder away and write a new manifest (rigctl export)", path, expected);
    return -EINVAL;
}

static int read_chain(struct chain *c, const char *dir)
{
    char path[PATH_MAX], *text;
    size_t n;
    *c = (struct chain){ 0 };
    snprintf(path, sizeof(path), "%s/ascmhl/ascmhl_chain.xml", dir);
    if (access(path, F_OK))
        return -errno;
    int err = file_read(&text, &n, path, 16 << 20);
    if (err)
        return err;
    const char *at = text, *end = text + n, *attributes;
    while (!err) {
        struct generation g = { .name = element(&at, end, "path", &attributes) };
        if (!g.name)
            break;
        g.c4 = element(&at, end, "c4", &attributes);
        struct generation *grown = realloc(c->generation, ((size_t)c->n + 1) * sizeof(*grown));
        if (grown)
            c->generation = grown;
        if (!grown || !g.c4 || strchr(g.name, '/') || strlen(g.name) < 8) {
            err = grown ? broken(path, "pairs of path and c4") : -ENOMEM;
            free(g.name), free(g.c4);
            break;
        }
        c->generation[c->n++] = g;
    }
    free(text);
    if (err)
        chain_free(c);
    return err;
}

// The last generation of the chain, checked against it.
static int read_generation(struct files *f, const char *dir, const struct generation *g)
{
    char path[PATH_MAX], c4[DIGEST_C4], *text;
    size_t n;
    *f = (struct files){ 0 };
    snprintf(path, sizeof(path), "%s/ascmhl/%s", dir, g->name);
    int err = file_read(&text, &n, path, MANIFEST_BYTES_MAX);
    if (err)
        return err;
    digest_c4(text, n, c4);
    if (strcmp(c4, g->c4)) {
        log_error("manifest: %s was changed after it was written: its C4 is %s, the chain says %s", path, c4, g->c4);
        err = -EBADMSG;
    }
    const char *at = text, *end = text + n, *attributes;
    while (!err) {
        char *name = element(&at, end, "path", &attributes);
        if (!name)
            break;
        const char *size = memmem(attributes, (size_t)(at - attributes), "size=\"", 6);
        const char *after = at;
        char *hash = element(&at, end, "xxh128", &attributes);
        const char *next_path = memmem(after, (size_t)(end - after), "<path", 5);
        struct file *added = NULL;
        if (!size || !hash || strlen(hash) != 32 || (next_path && next_path < attributes) || strstr(name, ".."))
            err = broken(path, "hash elements with path, size and xxh128");
        else if (!(added = add_file(f, name)))
            err = -ENOMEM;
        else {
            memcpy(added->xxh128, hash, sizeof(added->xxh128));
            added->size_bytes = strtoll(size + 6, NULL, 10);
        }
        if (!added && err != -ENOMEM)
            free(name);
        free(hash);
    }
    free(text);
    if (err)
        files_free(f);
    else if (f->n)
        qsort(f->file, (size_t)f->n, sizeof(*f->file), by_path);
    return err;
}

// ---- writing ---------------------------------------------------------------------------------------------------------------------

static int hash_all(struct files *f, const char *dir, const struct manifest_known *known, int n_known)
{
    for (int i = 0; i < f->n; i++) {
        struct file *file = &f->file[i];
        char path[PATH_MAX];
        for (int k = 0; k < n_known && !file->xxh128[0]; k++)
            if (known[k].size_bytes == file->size_bytes && strlen(known[k].xxh128) == 32 && !strcmp(known[k].path, file->path))
                memcpy(file->xxh128, known[k].xxh128, sizeof(file->xxh128));
        if (file->xxh128[0])
            continue;
        snprintf(path, sizeof(path), "%s/%s", dir, file->path);
        const int err = digest_file(path, 0, file->xxh128, &file->size_bytes);
        if (err) {
            log_error("manifest: cannot read %s: %s", path, strerror(-err));
            return err;
        }
    }
    return 0;
}

static void write_generation(FILE *out, const struct files *f, int64_t utc_s)
{
    char host[256] = "unknown";
    gethostname(host, sizeof(host) - 1);
    fputs("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<hashlist version=\"2.0\" xmlns=\"urn:ASC:MHL:v2.0\">\n  <creatorinfo>\n    <creationdate>", out);
    put_time(out, utc_s, ISO);
    fputs("</creationdate>\n    <hostname>", out);
    put_text(out, host);
    fputs("</hostname>\n    <tool version=\"" STUDIORIG_VERSION "\">studiorig rigd</tool>\n  </creatorinfo>\n  <processinfo>\n"
          "    <process>in-place</process>\n    <ignore>\n", out);
    for (size_t i = 0; i < sizeof(ignored) / sizeof(ignored[0]); i++)
        fprintf(out, "      <pattern>%s</pattern>\n", ignored[i]);
    fputs("    </ignore>\n  </processinfo>\n  <hashes>\n", out);
    for (int i = 0; i < f->n; i++) {
        fprintf(out, "    <hash>\n      <path size=\"%lld\" lastmodificationdate=\"", (long long)f->file[i].size_bytes);
        put_time(out, f->file[i].modified_s, ISO);
        fputs("\">", out);
        put_text(out, f->file[i].path);
        fprintf(out, "</path>\n      <xxh128 action=\"%s\" hashdate=\"", f->file[i].action);
        put_time(out, utc_s, ISO);
        fprintf(out, "\">%s</xxh128>\n    </hash>\n", f->file[i].xxh128);
    }
    fputs("  </hashes>\n</hashlist>\n", out);
}

static void remove_unchained(const char *dir, const struct chain *chain)
{
    char path[PATH_MAX];
    snprintf(path, sizeof(path), "%s/ascmhl", dir);
    DIR *d = opendir(path);
    for (const struct dirent *e; d && (e = readdir(d));) {
        const size_t n = strlen(e->d_name);
        bool stale = n > 4 && (!strcmp(e->d_name + n - 4, ".mhl") || !strcmp(e->d_name + n - 5, ".part"));
        for (int i = 0; i < chain->n; i++)
            stale &= strcmp(e->d_name, chain->generation[i].name) != 0;
        if (stale)
            unlinkat(dirfd(d), e->d_name, 0);
    }
    if (d)
        closedir(d);
}

static int write_text(const char *path, const char *text, size_t n)
{
    struct atomic_file f;
    const int err = atomic_file_open(&f, path);
    if (err)
        return err;
    fwrite(text, 1, n, f.stream);
    return atomic_file_commit(&f);
}

static int write_chain(const char *dir, const struct chain *chain, const char *name, const char *c4)
{
    char path[PATH_MAX], *text = NULL;
    size_t n = 0;
    FILE *out = open_memstream(&text, &n);
    if (!out)
        return -ENOMEM;
    fputs("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<ascmhldirectory xmlns=\"urn:ASC:MHL:DIRECTORY:v2.0\">\n", out);
    for (int i = 0; i <= chain->n; i++) {
        fprintf(out, "  <hashlist sequencenr=\"%d\">\n    <path>", i + 1);
        put_text(out, i < chain->n ? chain->generation[i].name : name);
        fprintf(out, "</path>\n    <c4>%s</c4>\n  </hashlist>\n", i < chain->n ? chain->generation[i].c4 : c4);
    }
    fputs("</ascmhldirectory>\n", out);
    snprintf(path, sizeof(path), "%s/ascmhl/ascmhl_chain.xml", dir);
    const int err = fclose(out) ? -ENOMEM : write_text(path, text, n);
    free(text);
    return err;
}

int manifest_write(const char *dir, const struct manifest_known *known, int n_known, int64_t utc_s)
{
    struct chain chain = { 0 };
    struct files now = { 0 }, last = { 0 };
    char path[PATH_MAX], real[PATH_MAX], c4[DIGEST_C4], *text = NULL;
    size_t n_text = 0;
    bool differs = false;
    int err = realpath(dir, real) ? walk(&now, dir, "", 0) : -errno;
    if (err) {
        log_error("manifest: cannot list %s: %s", dir, strerror(-err));
        return err;
    }
    if (now.n)
        qsort(now.file, (size_t)now.n, sizeof(*now.file), by_path);
    err = read_chain(&chain, dir);
    if (err == -ENOENT)
        err = 0;
    if (!err && chain.n)
        err = read_generation(&last, dir, &chain.generation[chain.n - 1]);
    if (!err)
        err = hash_all(&now, dir, known, n_known);
    if (err)
        goto done;
    for (int i = 0; i < now.n; i++) {
        const struct file *before = find(&last, now.file[i].path);
        const bool same = before && before->size_bytes == now.file[i].size_bytes && !strcmp(before->xxh128, now.file[i].xxh128);
        now.file[i].action = !before ? "original" : same ? "verified" : "failed";
        if (before && !same) {
            differs = true;
            log_error("manifest: %s/%s has changed since %s", dir, now.file[i].path, chain.generation[chain.n - 1].name);
        }
    }
    for (int i = 0; i < last.n; i++)
        if (!find(&now, last.file[i].path)) {
            differs = true;
            log_error("manifest: %s/%s is gone since %s", dir, last.file[i].path, chain.generation[chain.n - 1].name);
        }
    if (!now.n) { // a take that failed before the shot; the schema wants at least one file
        err = differs ? -EBADMSG : 0;
        goto done;
    }
    FILE *out = open_memstream(&text, &n_text);
    if (!out) {
        err = -ENOMEM;
        goto done;
    }
    write_generation(out, &now, utc_s);
    if (fclose(out)) {
        err = -ENOMEM;
        goto done;
    }
    digest_c4(text, n_text, c4);
    snprintf(path, sizeof(path), "%s/ascmhl", dir);
    err = make_directories(path);
    if (err)
        goto done;
    remove_unchained(dir, &chain);
    char name[300], stamp[40];
    struct tm tm;
    const time_t t = (time_t)utc_s;
    gmtime_r(&t, &tm);
    strftime(stamp, sizeof(stamp), "%Y-%m-%d_%H%M%SZ", &tm);
    snprintf(name, sizeof(name), "%04d_%.200s_%s.mhl", chain.n + 1, strrchr(real, '/') + 1, stamp);
    if (snprintf(path, sizeof(path), "%s/ascmhl/%s", dir, name) >= (int)sizeof(path)) {
        err = -ENAMETOOLONG;
        goto done;
    }
    err = write_text(path, text, n_text);
    if (!err)
        err = write_chain(dir, &chain, name, c4);
    if (!err && differs)
        err = -EBADMSG;
done:
    free(text);
    files_free(&now);
    files_free(&last);
    chain_free(&chain);
    return err;
}

int manifest_verify(const char *dir, struct manifest_findings *found)
{
    struct chain chain = { 0 };
    struct files now = { 0 }, last = { 0 };
    *found = (struct manifest_findings){ 0 };
    int err = read_chain(&chain, dir);
    if (!err && !chain.n)
        err = -EINVAL;
    for (int i = 0; i < chain.n && !err; i++) { // each generation against the chain, the last is what counts
        files_free(&last);
        err = read_generation(&last, dir, &chain.generation[i]);
    }
    if (!err)
        err = walk(&now, dir, "", 0);
    if (err)
        goto done;
    if (now.n)
        qsort(now.file, (size_t)now.n, sizeof(*now.file), by_path);
    err = hash_all(&now, dir, NULL, 0);
    if (err)
        goto done;
    for (int i = 0; i < last.n; i++) {
        const struct file *f = find(&now, last.file[i].path);
        found->n_files++;
        if (!f) {
            found->n_missing++;
            log_error("manifest: %s/%s is missing", dir, last.file[i].path);
        } else if (f->size_bytes != last.file[i].size_bytes || strcmp(f->xxh128, last.file[i].xxh128)) {
            found->n_changed++;
            log_error("manifest: %s/%s: found xxh128 %s, the manifest says %s", dir, f->path, f->xxh128, last.file[i].xxh128);
        }
    }
    for (int i = 0; i < now.n; i++)
        found->n_new += !find(&last, now.file[i].path);
    if (found->n_missing || found->n_changed)
        err = -EBADMSG;
done:
    files_free(&now);
    files_free(&last);
    chain_free(&chain);
    return err;
}
