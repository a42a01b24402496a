// tests/fuzz/fuzz_control.c - hostile clients: every line is answered at most once, with JSON, and nothing else happens.
#include "rigd/control.h"
#include "solver/take/log.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static uint64_t kept[4096];
static int n_kept;

static void handle(void *arg, uint64_t token, const char *what, const struct json *request)
{
    struct control *c = *(struct control **)arg;
    (void)request;
    if (what[0] == 'k' && n_kept < 4096)
        kept[n_kept++] = token; // later
    else if (what[0] == 'r')
        control_refuse(c, token, "no", what);
    else
        control_reply(c, token, json_new_object());
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct control *c;
    log_set_level(LOG_SILENT);
    n_kept = 0;
    if (control_open_virtual(&c, handle, &c))
        abort();
    const int a = control_virtual_client(c), b = control_virtual_client(c);
    const size_t cut = n ? bytes[0] * n / 256 : 0;
    control_feed(c, a, (const char *)bytes, cut);
    control_feed(c, b, (const char *)bytes, n);
    control_feed(c, a, (const char *)bytes + cut, n - cut);
    control_publish(c, "e", json_new_object());
    for (int i = 0; i < n_kept; i++) {
        control_reply(c, kept[i], json_new_object());
        control_reply(c, kept[i], json_new_object()); // answered once all the same
    }
    char *out = control_take(c, a);
    for (char *line = strtok(out, "\n"); line; line = strtok(NULL, "\n")) {
        struct json *doc;
        if (json_parse(&doc, line, strlen(line), NULL))
            abort();
        json_free(doc);
    }
    free(out);
    control_close(c);
    return 0;
}
