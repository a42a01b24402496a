// rigd/access.c - a request is judged before it is read.
#include "rigd/access.h"
#include "solver/take/log.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

// ---- addresses -----------------------------------------------------------------------------------------------------------------

int listen_parse(struct listen_address *out, const char *text)
{
    struct sockaddr_in *v4 = (struct sockaddr_in *)&out->address;
    struct sockaddr_in6 *v6 = (struct sockaddr_in6 *)&out->address;
    char host[INET6_ADDRSTRLEN];
    memset(out, 0, sizeof(*out));
    const char *colon = strrchr(text, ':');
    const size_t n_digits = colon ? strspn(colon + 1, "0123456789") : 0;
    if (!n_digits || n_digits > 5 || colon[1 + n_digits] || atoi(colon + 1) > 65535)
        return -EINVAL;
    const bool bracketed = text[0] == '[' && colon > text + 1 && colon[-1] == ']';
    const size_t n = (size_t)(colon - text) - (bracketed ? 2 : 0);
    if (n >= sizeof(host))
        return -EINVAL;
    memcpy(host, text + bracketed, n);
    host[n] = 0;
    out->port = atoi(colon + 1);
    if (bracketed && inet_pton(AF_INET6, host, &v6->sin6_addr) == 1) {
        v6->sin6_family = AF_INET6;
        v6->sin6_port = htons((uint16_t)out->port);
        out->length = sizeof(*v6);
        out->is_loopback = IN6_IS_ADDR_LOOPBACK(&v6->sin6_addr);
    } else if (!bracketed && inet_pton(AF_INET, host, &v4->sin_addr) == 1) {
        v4->sin_family = AF_INET;
        v4->sin_port = htons((uint16_t)out->port);
        out->length = sizeof(*v4);
        out->is_loopback = ntohl(v4->sin_addr.s_addr) >> 24 == 127;
    } else {
        return -EINVAL;
    }
    return 0;
}

// ---- token -----------------------------------------------------------------------------------------------------------------------

static bool is_token(const char *text, size_t n)
{
    return n == ACCESS_TOKEN_LENGTH && strspn(text, "0123456789abcdef") == n;
}

static int read_token(char out[ACCESS_TOKEN_LENGTH + 1], const char *path)
{
    struct stat st;
    char text[ACCESS_TOKEN_LENGTH + 8];
    const int fd = open(path, O_RDONLY | O_NOFOLLOW | O_CLOEXEC | O_NONBLOCK);
    if (fd < 0)
        return -errno; // -ENOENT is the first start; others are said by who asked
    const ssize_t n = fstat(fd, &st) || !S_ISREG(st.st_mode) ? -1 : read(fd, text, sizeof(text) - 1);
    close(fd);
    if (n < 0 || st.st_mode & 077) {
        log_error("web: %s: expected a file that only rigd's user may read: chmod 600, or remove it and a new token is drawn", path);
        return -EACCES;
    }
    text[n] = 0;
    text[strcspn(text, "\r\n")] = 0;
    if (!is_token(text, strlen(text))) {
        log_error("web: %s: found no token, expected %d hexadecimal digits; remove it and a new one is drawn", path, ACCESS_TOKEN_LENGTH);
        return -EINVAL;
    }
    memcpy(out, text, ACCESS_TOKEN_LENGTH + 1);
    return 0;
}

int access_token(char out[ACCESS_TOKEN_LENGTH + 1], const char *path)
{
    unsigned char drawn[ACCESS_TOKEN_LENGTH / 2];
    int err = read_token(out, path);
    if (err != -ENOENT) {
        if (err && err != -EACCES && err != -EINVAL)
            log_error("web: cannot read the token in %s: %s", path, strerror(-err));
        return err;
    }
    const int fd = open(path, O_WRONLY | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0600);
    err = fd < 0 ? -errno : getrandom(drawn, sizeof(drawn), 0) != sizeof(drawn) ? -EIO : 0;
    for (size_t i = 0; !err && i < sizeof(drawn); i++)
        snprintf(out + 2 * i, 3, "%02x", drawn[i]);
    if (!err && dprintf(fd, "%s\n", out) != ACCESS_TOKEN_LENGTH + 1) // one that is cut is found at the next start
        err = -EIO;
    if (fd >= 0)
        close(fd);
    if (err) {
        log_error("web: cannot write the token to %s: %s", path, strerror(-err));
        memset(out, 0, ACCESS_TOKEN_LENGTH + 1);
    }
    return err;
}

bool access_is_token(const char token[ACCESS_TOKEN_LENGTH + 1], const char *given)
{
    unsigned char differs = 0;
    if (!given || strlen(given) != ACCESS_TOKEN_LENGTH)
        return false;
    for (int i = 0; i < ACCESS_TOKEN_LENGTH; i++)
        differs |= (unsigned char)token[i] ^ (unsigned char)given[i];
    return !differs;
}

// ---- requests ----------------------------------------------------------------------------------------------------------------------

// host[:port] without its port; false: none.
static bool host_name(const char *host, char *out, size_t room)
{
    const char *end = host[0] == '[' ? strchr(host, ']') : host + strcspn(host, ":");
    if (!end)
        return false;
    end += host[0] == '[';
    const size_t n = (size_t)(end - host), n_digits = *end ? strspn(end + 1, "0123456789") : 0;
    if (!n || n >= room || (*end && (*end != ':' || !n_digits || n_digits > 5 || end[1 + n_digits])))
        return false;
    memcpy(out, host, n);
    out[n] = 0;
    return true;
}

static bool is_own_name(const char *host, const char *own_host)
{
    char name[80], own[80];
    if (!host_name(host, name, sizeof(name)))
        return false;
    return !strcasecmp(name, "localhost") || !strcmp(name, "127.0.0.1") || !strcmp(name, "[::1]") || (host_name(own_host, own, sizeof(own)) && !strcmp(name, own));
}

// A page's origin is ours when it names the host that is asked: a browser does not let a page lie about either.
static bool is_own_origin(const char *origin, const char *host)
{
    const size_t scheme = !strncasecmp(origin, "http://", 7) ? 7 : !strncasecmp(origin, "https://", 8) ? 8 : 0;
    return scheme && host && !strcasecmp(origin + scheme, host);
}

enum access access_judge(const struct access_request *r, const char *token, const char *own_host)
{
    char name[300];
    if (!r->host || (token ? !host_name(r->host, name, sizeof(name)) : !is_own_name(r->host, own_host)))
        return ACCESS_WRONG_HOST;
    if (r->origin && !is_own_origin(r->origin, r->host))
        return ACCESS_WRONG_ORIGIN;
    // Without Origin come pictures, frames and windows of other pages. They may link to what is over soon.
    if ((r->changes || r->stays) && r->fetch_site && strcasecmp(r->fetch_site, "same-origin") && strcasecmp(r->fetch_site, "none"))
        return ACCESS_WRONG_ORIGIN;
    const char *bearer = r->authorization && !strncasecmp(r->authorization, "Bearer ", 7) ? r->authorization + 7 : NULL;
    if (token && !access_is_token(token, bearer) && !access_is_token(token, r->cookie))
        return ACCESS_NO_TOKEN;
    // Only a script may send JSON, and one of another site has to ask first, which nobody answers.
    if (r->changes && (!r->content_type || strncasecmp(r->content_type, "application/json", 16) || (r->content_type[16] && !strchr("; \t", r->content_type[16]))))
        return ACCESS_WRONG_TYPE;
    return ACCESS_GRANTED;
}
