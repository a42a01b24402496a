// rigd/trigger.c - the trigger that rigd.conf asks for.
#include "rigd/trigger.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdlib.h>

struct trigger {
    const struct trigger_ops *ops;
    void *self;
};

int trigger_open(struct trigger **out, const struct config *config, const struct trigger_host *host)
{
    static const struct trigger_ops *const ops[] = { [TRIGGER_SOFTWARE] = &trigger_software, [TRIGGER_GPIO] = &trigger_gpio,
        [TRIGGER_USB] = &trigger_usb, [TRIGGER_SIMULATED] = &trigger_simulated };
    *out = NULL;
    struct trigger *t = calloc(1, sizeof(*t));
    if (!t)
        return -ENOMEM;
    t->ops = ops[config->trigger.kind];
    const int err = t->ops->open(&t->self, config, host);
    if (err) {
        free(t);
        return err;
    }
    *out = t;
    return 0;
}

unsigned trigger_abilities(const struct trigger *t)
{
    return t->ops->abilities(t->self);
}

int trigger_fire(struct trigger *t, const struct trigger_shot *shot)
{
    return shot->on_button && !(t->ops->abilities(t->self) & TRIGGER_WAITS) ? -ENOTSUP : t->ops->fire(t->self, shot);
}

void trigger_release(struct trigger *t)
{
    t->ops->release(t->self);
}

int trigger_relay(struct trigger *t, int camera, bool cut)
{
    return t->ops->relay ? t->ops->relay(t->self, camera, cut) : -ENOTSUP;
}

int trigger_head(struct trigger *t, int32_t yaw_mdeg, int32_t pitch_mdeg)
{
    return t->ops->head ? t->ops->head(t->self, yaw_mdeg, pitch_mdeg) : -ENOTSUP;
}

int trigger_identify(struct trigger *t, int ms)
{
    return t->ops->identify ? t->ops->identify(t->self, ms) : -ENOTSUP;
}

int trigger_fd(const struct trigger *t)
{
    return t->ops->fd(t->self);
}

void trigger_dispatch(struct trigger *t)
{
    t->ops->dispatch(t->self);
}

void trigger_close(struct trigger *t)
{
    if (t)
        t->ops->close(t->self);
    free(t);
}
