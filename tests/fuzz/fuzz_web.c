// tests/fuzz/fuzz_web.c - hostile headers and paths: nobody gets in without the token or by a foreign name, no path leaves a take.
#include "rigd/access.h"
#include "rigd/take_files.h"
#include "solver/take/log.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static const char token[] = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    char *text = malloc(n + 1), *part[7] = { NULL }, *rest = text;
    struct listen_address address;
    log_set_level(LOG_SILENT);
    memcpy(text, bytes, n);
    text[n] = 0;
    for (char *c = text; c < text + n; c++)
        *c = *c ? *c : 'x';
    for (int i = 0; i < 7; i++) // "-": not there
        part[i] = strsep(&rest, "\n");
    for (int i = 0; i < 7; i++)
        if (part[i] && !strcmp(part[i], "-"))
            part[i] = NULL;
    const struct access_request r = { n % 2, part[0], part[1], part[2], part[3], part[4], part[5] };
    if (access_judge(&r, token, "192.168.1.5:8420") == ACCESS_GRANTED && (!r.authorization || !strstr(r.authorization, token)) && (!r.cookie || strcmp(r.cookie, token)))
        abort();
    if (access_judge(&r, NULL, "127.0.0.1:8420") == ACCESS_GRANTED && strncasecmp(r.host, "localhost", 9) && strncmp(r.host, "127.0.0.1", 9) && strncmp(r.host, "[::1]", 5))
        abort();
    if (access_judge(&r, NULL, "127.0.0.1:8420") == ACCESS_GRANTED && r.origin && !strstr(r.origin, "://"))
        abort();
    const char *path = part[6] ? part[6] : "";
    int64_t size;
    if (take_file_type(path)) {
        if (path[0] == '/' || path[0] == '.' || strstr(path, "/.") || strstr(path, "//") || strchr(path, '\\') || strchr(path, '%'))
            abort();
        if (strncmp(path, "thumbnails/", 11) && strncmp(path, "solve/", 6) && strncmp(path, "sheet/", 6))
            abort();
    } else if (take_file_open("/", "usr", path, &size) != -2) { // ENOENT
        abort();
    }
    if (!listen_parse(&address, path) && (address.port < 0 || address.port > 65535 || !address.length))
        abort();
    free(text);
    return 0;
}
