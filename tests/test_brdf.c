// tests/test_brdf.c - rigsolve brdf: what it prints, what it judges, and how it refuses bad tables.
//
// Commands are not in the library, so this includes the command's source and what it stands on.
#include "solver/commands/arguments.c"
#include "solver/commands/output.c"
#include "solver/commands/brdf.c"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

static char message[512];

static void keep_message(void *arg, enum log_level level, const char *text)
{
    (void)arg, (void)level;
    snprintf(message, sizeof(message), "%s", text);
}

static int set_up(void **state)
{
    (void)state;
    log_set_hook(keep_message, NULL);
    return 0;
}

static void assert_said(const char *what)
{
    if (!strstr(message, what))
        fail_msg("'%s' does not say '%s'", message, what);
}

static const char case_header[] = "n_x,n_y,n_z,tx_x,tx_y,tx_z,ty_x,ty_y,ty_z,v_x,v_y,v_z,l_x,l_y,l_z,albedo_r,albedo_g,albedo_b,metallic,"
                                  "subsurface,specular,roughness,specularTint,anisotropic,sheen,sheenTint,clearcoat,clearcoatGloss";
static const char good_case[] = "0,0,1,1,0,0,0,1,0,0,0,1,0,0,1,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,0";

static void bad_cases_are_named(void **state)
{
    (void)state;
    static const struct {
        const char *row, *said;
    } bad[] = {
        { "0,0,1,1,0,0,0,1,0,0,0,1,0,0,1,.5,.5,.5,0,0,.5,1.01,0,0,0,0,0,0", ":3: column 'roughness': found 1.01" },
        { "0,0,1,1,0,0,0,1,0,0,0,1,0,0,1,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,-.1", ":3: column 'clearcoatGloss': found -0.1" },
        { "0,0,1,1,0,0,0,1,0,0,0,1,0,0,1,.5,-.5,.5,0,0,.5,.5,0,0,0,0,0,0", ":3: column 'albedo_g': found -0.5" },
        { "0,0,1,1,0,0,0,1,0,0,0,2,0,0,1,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,0", ":3: columns 'v_x' to 'v_z': a vector of length 2" },
        { "0,0,1,1,0,0,0,1,0,0,0,1,0,0,0,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,0", ":3: columns 'l_x' to 'l_z': a vector of length 0" },
        { "0,0,1,.6,0,.8,0,1,0,0,0,1,0,0,1,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,0", ":3: columns 'n_x' and 'tx_x'" },
        { "0,0,one,1,0,0,0,1,0,0,0,1,0,0,1,.5,.5,.5,0,0,.5,.5,0,0,0,0,0,0", ":3: column 'n_z': found 'one'" },
        { "0,0,1,1,0,0,0,1,0,0,0,1,0,0,1", ":3: found 15 fields, expected 28" },
    };
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64], out[64];
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/cases.csv", dir);
    snprintf(out, sizeof(out), "%s/out.csv", dir);
    char *arguments[] = { (char[]){ "rigsolve brdf" }, path, (char[]){ "-o" }, out, NULL };
    for (size_t i = 0; i <= sizeof(bad) / sizeof(bad[0]); i++) {
        const int is_good = i == sizeof(bad) / sizeof(bad[0]);
        FILE *f = fopen(path, "w");
        assert_non_null(f);
        fprintf(f, "%s\n%s\n%s\n", case_header, good_case, is_good ? good_case : bad[i].row);
        fclose(f);
        message[0] = 0;
        assert_int_equal(command_brdf(4, arguments), is_good ? EXIT_DONE : EXIT_FAILED);
        if (!is_good)
            assert_said(bad[i].said);
        f = fopen(out, "r");
        assert_true((f != NULL) == is_good); // nothing half-written
        if (f)
            fclose(f);
    }
    remove(path), remove(out), remove(dir);
}

static void printed_tables_are_read_back_as_they_were(void **state)
{
    (void)state;
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64], out[64];
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/cases.csv", dir);
    snprintf(out, sizeof(out), "%s/out.csv", dir);
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fprintf(f, "%s\n%s\n", case_header, good_case);
    fclose(f);
    for (int which = 0; which < 2; which++) {
        char *arguments[] = { (char[]){ "rigsolve brdf" }, path, (char[]){ "-o" }, out, (char[]){ "--kernel" },
                              which ? (char[]){ "portable" } : (char[]){ "reference" }, NULL };
        assert_int_equal(command_brdf(6, arguments), EXIT_DONE);
        struct csv c;
        double value;
        assert_int_equal(csv_open(&c, out), 0);
        assert_int_equal(c.n_columns, which ? 42 : 60);
        assert_int_equal(csv_find(&c, "f_r"), 0);
        assert_int_equal(csv_find(&c, "df_b_dalbedo_b"), 41);
        assert_int_equal(csv_find(&c, "df_g_dclearcoatGloss"), 3 + 19);
        assert_true((csv_find(&c, "df_r_dl_x") == 42) == !which);
        assert_int_equal(csv_next_row(&c), 1);
        assert_int_equal(csv_number(&c, 0, &value), 0);
        const struct disney m = { .theta = { [DISNEY_SPECULAR] = .5, [DISNEY_ROUGHNESS] = .5 }, .albedo = { .5, .5, .5 } };
        const struct disney_frame frame = { .n = { 0, 0, 1 }, .x = { 1, 0, 0 }, .y = { 0, 1, 0 } };
        const double up[3] = { 0, 0, 1 };
        double want[3];
        disney_eval(&m, &frame, up, up, want);
        assert_true(which ? value > want[0] * (1 - 1e-6) && value < want[0] * (1 + 1e-6) : value == want[0]);
        assert_int_equal(csv_next_row(&c), 0);
        csv_close(&c);
    }
    remove(path), remove(out), remove(dir);
}

// --check passes its own output and notices one wrong digit, at the bounds that --help promises.
static void check_notices_a_wrong_value(void **state)
{
    (void)state;
    static const struct {
        const char *kernel;
        double factor;
        int code;
    } checks[] = { { "reference", 1, EXIT_DONE },          { "reference", 1 + 1e-10, EXIT_DONE },
                   { "reference", 1 + 2e-9, EXIT_FAILED }, { "portable", 1, EXIT_DONE },
                   { "portable", 1 + 3e-3, EXIT_FAILED } };
    const struct disney m = { .theta = { [DISNEY_SPECULAR] = .5, [DISNEY_ROUGHNESS] = .5 }, .albedo = { .5, .5, .5 } };
    const struct disney_frame frame = { .n = { 0, 0, 1 }, .x = { 1, 0, 0 }, .y = { 0, 1, 0 } };
    const double up[3] = { 0, 0, 1 };
    double f[3];
    disney_eval(&m, &frame, up, up, f);
    char dir[] = "/tmp/studiorig-test-XXXXXX", path[64];
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof(path), "%s/cases.csv", dir);
    for (size_t i = 0; i < sizeof(checks) / sizeof(checks[0]); i++) {
        FILE *file = fopen(path, "w");
        assert_non_null(file);
        fprintf(file, "f_g,%s\n%.17g,%s\n", case_header, f[1] * checks[i].factor, good_case);
        fclose(file);
        char kernel[16];
        snprintf(kernel, sizeof(kernel), "%s", checks[i].kernel);
        char *arguments[] = { (char[]){ "rigsolve brdf" }, path, (char[]){ "--json" }, (char[]){ "--kernel" }, kernel, NULL };
        assert_int_equal(command_brdf(5, arguments), checks[i].code);
        if (checks[i].code)
            assert_said("outside the bounds");
    }
    FILE *file = fopen(path, "w");
    assert_non_null(file);
    fprintf(file, "%s\n%s\n", case_header, good_case);
    fclose(file);
    char *arguments[] = { (char[]){ "rigsolve brdf" }, path, (char[]){ "--check" }, NULL };
    assert_int_equal(command_brdf(3, arguments), EXIT_FAILED);
    assert_said("nothing to compare");
    remove(path), remove(dir);
}

static void every_kernel_reproduces_the_reference_cases(void **state)
{
    (void)state;
    static const char *const kernels[] = { "reference", "portable", "avx2", "avx512" };
    char cases[] = "../shared/data/brdf_cases.csv";
    FILE *file = fopen(cases, "r");
    if (!file) {
        fprintf(stderr, "# no %s: not checked\n", cases);
        return;
    }
    fclose(file);
    for (int i = 0; i < 4; i++) {
        char kernel[16];
        snprintf(kernel, sizeof(kernel), "%s", kernels[i]);
        if (!kernels_by_name(kernel))
            continue;
        printf("# ");
        char *arguments[] = { (char[]){ "rigsolve brdf" }, cases, (char[]){ "--json" }, (char[]){ "--kernel" }, kernel, NULL };
        assert_int_equal(command_brdf(5, arguments), EXIT_DONE);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(bad_cases_are_named),
        cmocka_unit_test(printed_tables_are_read_back_as_they_were),
        cmocka_unit_test(check_notices_a_wrong_value),
        cmocka_unit_test(every_kernel_reproduces_the_reference_cases),
    };
    return cmocka_run_group_tests(tests, set_up, NULL);
}
