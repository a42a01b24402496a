// rigd/access.h - who may ask over HTTP: addresses, the token, and which headers a request must have.
//
// Pure but for access_token(). What it keeps out: other machines and users without the token; pages of other sites that make a
// visitor's browser ask for them (Origin, Sec-Fetch-Site, Content-Type), also by a name of theirs that suddenly means 127.0.0.1 (Host).
#pragma once
#include <stdbool.h>
#include <sys/socket.h>

struct listen_address {
    struct sockaddr_storage address;
    socklen_t length;
    int port;
    bool is_loopback; // nobody else's machine gets there
};

// "127.0.0.1:8420" or "[::1]:8420", numbers only. 0 or -EINVAL.
int listen_parse(struct listen_address *out, const char *text);

enum { ACCESS_TOKEN_LENGTH = 64 };

// The token kept in path (mode 0600); drawn and written when there is none. 0, -EACCES (others may read or write it: logged),
// -EINVAL (no token in it: logged) or another -errno (logged).
int access_token(char out[ACCESS_TOKEN_LENGTH + 1], const char *path);

// given NULL: no. Takes the same time wherever they differ.
bool access_is_token(const char token[ACCESS_TOKEN_LENGTH + 1], const char *given);

struct access_request { // headers as they came; NULL: not there
    bool changes;       // POST: anything but looking
    bool stays;         // an event stream: it would hold one of few places for as long as a foreign page likes
    const char *host, *origin, *fetch_site, *content_type;
    const char *authorization, *cookie;
};

enum access { ACCESS_GRANTED, ACCESS_WRONG_HOST, ACCESS_WRONG_ORIGIN, ACCESS_WRONG_TYPE, ACCESS_NO_TOKEN };

// token NULL: none is wanted, and for that the Host must be one of this machine's own names. own_host: the address we listen on, as
// in listen_parse().
enum access access_judge(const struct access_request *request, const char *token, const char *own_host);
