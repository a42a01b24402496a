// tests/fuzz/fuzz_csv.c - the table reader on hostile text: no crash, and every row has as many fields as the header.
#include "solver/csv.h"

#include <assert.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    struct csv c;
    if (csv_open_text(&c, (const char *)data, size, "fuzz.csv")) {
        assert(!c.text && !c.column);
        return 0;
    }
    size_t n_characters = 0;
    while (csv_next_row(&c) == 1)
        for (int i = 0; i < c.n_columns; i++) {
            double value;
            n_characters += strlen(c.field[i]);
            if (!csv_number(&c, i, &value))
                assert(isfinite(value));
        }
    assert(n_characters <= size);
    csv_close(&c);
    return 0;
}
