// tests/fuzz/fuzz_json.c - hostile JSON: an error, or a tree that every getter can walk and that
// survives a round trip.
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static const char *const paths[] = {
        "", "0", "a", "a.0", "a.b", "lights.3.dir_probe", "0.0.0", ".", "..", "a.", "99999999999"
    };
    struct json *doc, *again;
    log_set_level(LOG_SILENT);
    if (json_parse(&doc, (const char *)bytes, n, "fuzz")) {
        if (doc)
            abort();
        return 0;
    }
    for (size_t i = 0; i < sizeof(paths) / sizeof(paths[0]); i++) {
        double numbers[9];
        int64_t integer;
        bool truth;
        const char *string;
        json_length(doc, paths[i]);
        if (json_get_number(doc, paths[i], numbers) == 0 && !isfinite(numbers[0]))
            abort();
        json_get_int(doc, paths[i], &integer);
        json_get_bool(doc, paths[i], &truth);
        json_get_string(doc, paths[i], &string);
        json_require_numbers(doc, paths[i], numbers, 9, "fuzz");
        json_require_string(doc, paths[i], &string, "fuzz");
    }
    char *text = json_text(doc);
    if (!text || json_parse(&again, text, strlen(text), "again"))
        abort();
    char *same = json_text(again);
    if (!same || strcmp(text, same))
        abort();
    free(same);
    free(text);
    json_free(again);
    json_free(doc);
    return 0;
}
