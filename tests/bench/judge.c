// tests/bench/judge.c - judge SOLVE_DIR TAKE [--json]: a solve beside the truth of its take, as one
// line. A figure that is not known or does not apply is "-"; in JSON null, as is an infinite one.
#include "tests/judgement.h"

static struct json *by_name(const double value[DISNEY_N])
{
    struct json *v = json_object();
    for (int k = 0; k < DISNEY_N; k++)
        json_set_number(v, disney_parameter_names[k], value[k]);
    return v;
}

static int print_json(const struct judgement *j)
{
    struct json *doc = json_object();
    double in_std[DISNEY_N];
    for (int k = 0; k < DISNEY_N; k++)
        in_std[k] = j->theta_error[k] / j->theta_std[k];
    json_set_string(doc, "method", j->method);
    if (j->trusted >= 0)
        json_set_bool(doc, "trusted", j->trusted);
    json_set_number(doc, "rmse_fit_percent", j->rmse_fit_percent);
    json_set_number(doc, "rmse_held_out_percent", j->rmse_held_out_percent);
    json_set_int(doc, "n_lights", j->n_lights);
    json_set_int(doc, "n_off_panels", j->n_off_panels);
    json_set_int(doc, "n_directional", j->n_directional);
    json_set_number(doc, "distance_percent", j->distance_percent);
    json_set_number(doc, "distance_median_percent", j->distance_median_percent);
    json_set_number(doc, "distance_weighted_percent", j->distance_weighted_percent);
    json_set_number(doc, "distance_weighted_median_percent", j->distance_weighted_median_percent);
    json_set_number(doc, "position_cm", j->position_cm);
    json_set_number(doc, "position_weighted_cm", j->position_weighted_cm);
    json_set_number(doc, "centre_cm", j->centre_cm);
    json_set_number(doc, "rotation_deg", j->rotation_deg);
    json_set(doc, "theta", by_name(j->theta));
    json_set(doc, "theta_true", by_name(j->theta_true));
    json_set_bool(doc, "theta_uniform", j->theta_uniform);
    json_set(doc, "theta_error", by_name(j->theta_error));
    json_set(doc, "theta_error_in_std", by_name(in_std));
    json_set_int(doc, "n_texels", j->n_texels);
    json_set_int(doc, "n_covered_texels", j->n_covered_texels);
    json_set_number(doc, "albedo_percent", j->albedo_percent);
    json_set_number(doc, "albedo_scaled_percent", j->albedo_scaled_percent);
    json_set_number(doc, "albedo_scale", j->albedo_scale);
    json_set_number(doc, "wall_s", j->wall_s);
    json_set_number(doc, "n_jacobians", j->n_jacobians);
    char *text = json_text(doc);
    json_free(doc);
    const bool printed = text && puts(text) >= 0;
    free(text);
    return printed ? 0 : -EIO;
}

static void print(const char *before, double value, const char *unit)
{
    if (isnan(value))
        printf("%s-%s", before, unit);
    else
        printf("%s%.3g%s", before, value, unit);
}

static void print_line(const struct judgement *j)
{
    printf("%s%s", j->method, j->trusted == 0 ? " (not trusted)" : "");
    print("  RMSE fit ", j->rmse_fit_percent, "");
    print(" / held-out ", j->rmse_held_out_percent, " %");
    print("  distance ", j->distance_percent, "");
    print(" (median ", j->distance_median_percent, ";");
    print(" weighted ", j->distance_weighted_percent, ",");
    print(" median ", j->distance_weighted_median_percent, ") %");
    printf(" of %d lights, %d directional, %d off the panels", j->n_lights, j->n_directional,
           j->n_off_panels);
    print("  position ", j->position_cm, "");
    print(" (weighted ", j->position_weighted_cm, ") cm");
    print("  centre ", j->centre_cm, " cm");
    print("  rotation ", j->rotation_deg, " deg");
    printf("  theta%s", j->theta_uniform ? "" : " (against means)");
    for (int k = 0; k < DISNEY_N; k++) {
        printf(" %s", disney_parameter_names[k]);
        print(" ", j->theta_error[k], "");
        print(" (", j->theta_error[k] / j->theta_std[k], " std)");
    }
    print("  albedo ", j->albedo_percent, "");
    print(" (scaled ", j->albedo_scaled_percent, ")");
    printf(" %% of %d texels of %d", j->n_texels, j->n_covered_texels);
    print("  ", j->wall_s, " s");
    print("  ", j->n_jacobians, " Jacobians\n");
}

int main(int argc, char **argv)
{
    struct judgement j;
    const bool as_json = argc == 4 && !strcmp(argv[3], "--json");
    if (argc != 3 && !as_json) {
        fprintf(stderr, "usage: judge SOLVE_DIR TAKE [--json]\n");
        return 2;
    }
    if (judge_solve(&j, argv[1], argv[2]))
        return 1;
    if (as_json)
        return print_json(&j) || fflush(stdout) ? 1 : 0;
    print_line(&j);
    return fflush(stdout) ? 1 : 0;
}
