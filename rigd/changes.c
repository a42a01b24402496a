// rigd/changes.c - the last text of everything that was told, so that it is told once.
#include "rigd/changes.h"
#include "rigd/describe.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

struct changes {
    char *rig;
    int n_cameras;
    char *camera[]; // NULL: never told
};

int changes_create(struct changes **out, int n_cameras)
{
    *out = calloc(1, sizeof(**out) + (size_t)n_cameras * sizeof((*out)->camera[0]));
    if (*out)
        (*out)->n_cameras = n_cameras;
    return *out ? 0 : -ENOMEM;
}

void changes_free(struct changes *c)
{
    if (!c)
        return;
    free(c->rig);
    for (int i = 0; i < c->n_cameras; i++)
        free(c->camera[i]);
    free(c);
}

// Is v other than what *told says? Then that is what was told last.
static bool differs(char **told, const struct json *v)
{
    char *text = json_text(v);
    if (text && *told && !strcmp(text, *told)) {
        free(text);
        return false;
    }
    free(*told);
    *told = text;
    return true;
}

void changes_publish(struct changes *c, struct control *control, struct json *rig_part, const struct rig *rig, const struct config *config)
{
    struct json *list = json_new_array(), *body = json_new_object();
    int n = 0;
    for (int i = 0; i < c->n_cameras; i++) {
        struct json *camera = describe_camera(rig, config, i);
        if (differs(&c->camera[i], camera)) {
            json_append(list, camera);
            n++;
        } else {
            json_free(camera);
        }
    }
    json_set(body, "cameras", list);
    if (n)
        control_publish(control, "cameras", body);
    else
        json_free(body);
    if (differs(&c->rig, rig_part))
        control_publish(control, "rig", rig_part);
    else
        json_free(rig_part);
}
