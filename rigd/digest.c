// rigd/digest.c - xxh128 by the library; SHA-512 and base 58 by hand, for the one hash that ASC MHL's chain insists on.
#include "rigd/digest.h"

#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <xxhash.h>

struct digest {
    XXH3_state_t *state;
};

struct digest *digest_begin(void)
{
    struct digest *d = calloc(1, sizeof(*d));
    if (!d)
        return NULL;
    d->state = XXH3_createState();
    if (!d->state) {
        free(d);
        return NULL;
    }
    XXH3_128bits_reset(d->state);
    return d;
}

void digest_add(struct digest *d, const void *bytes, size_t n)
{
    XXH3_128bits_update(d->state, bytes, n);
}

static void to_hex(char *hex, const unsigned char *bytes, int n)
{
    for (int i = 0; i < n; i++) {
        hex[2 * i] = "0123456789abcdef"[bytes[i] >> 4];
        hex[2 * i + 1] = "0123456789abcdef"[bytes[i] & 15];
    }
    hex[2 * n] = 0;
}

void digest_end(struct digest *d, char hex[DIGEST_HEX])
{
    XXH128_canonical_t canonical;
    XXH128_canonicalFromHash(&canonical, XXH3_128bits_digest(d->state));
    if (hex)
        to_hex(hex, canonical.digest, 16);
    XXH3_freeState(d->state);
    free(d);
}

int digest_file(const char *path, int from_disk, char hex[DIGEST_HEX], int64_t *size_bytes)
{
    enum { CHUNK = 1 << 18 };
    int err = -ENOMEM;
    struct digest *d = NULL;
    char *buffer = NULL;
    int64_t size = 0;
    const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW);
    if (fd < 0)
        return -errno;
    if (from_disk)
        posix_fadvise(fd, 0, 0, POSIX_FADV_DONTNEED); // synced pages only: a dirty one has nothing on disk to read
    d = digest_begin();
    buffer = malloc(CHUNK);
    if (!d || !buffer)
        goto done;
    for (;;) {
        const ssize_t n = read(fd, buffer, CHUNK);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0) {
            err = -errno;
            goto done;
        }
        if (n == 0)
            break;
        digest_add(d, buffer, (size_t)n);
        size += n;
    }
    err = 0;
done:
    close(fd);
    free(buffer);
    if (d)
        digest_end(d, err ? NULL : hex);
    if (!err && size_bytes)
        *size_bytes = size;
    return err;
}

// ---- SHA-512 (FIPS 180-4): K are the first 64 bits of the fractional parts of the cube roots of the first 80 primes, H of the
// square roots of the first eight. Computed here in integers, so that no table can be mistyped.

typedef unsigned __int128 u128;

// floor(root(p) * 2^64) mod 2^64: the largest x with x^k <= p * 2^(64k), found bit by bit. x < 2^69: the power needs 207 bits,
// kept in 32-bit limbs.
static int power_exceeds(u128 x, int k, uint32_t p)
{
    uint32_t product[8] = { 1 }; // little-endian
    for (int i = 0; i < k; i++) {
        uint32_t next[8] = { 0 };
        for (int a = 0; a < 8; a++) {
            uint64_t carry = 0;
            for (int b = 0; b < 3 && a + b < 8; b++) {
                const uint64_t t = (uint64_t)product[a] * (uint32_t)(x >> (32 * b)) + next[a + b] + carry;
                next[a + b] = (uint32_t)t;
                carry = t >> 32;
            }
            for (int c = a + 3; carry && c < 8; c++) {
                const uint64_t t = (uint64_t)next[c] + carry;
                next[c] = (uint32_t)t;
                carry = t >> 32;
            }
        }
        memcpy(product, next, sizeof(product));
    }
    uint32_t bound[8] = { 0 };
    bound[2 * k] = p; // 2^(64k) begins at limb 2k
    for (int i = 7; i >= 0; i--)
        if (product[i] != bound[i])
            return product[i] > bound[i];
    return 0;
}

static uint64_t root_fraction(int k, uint32_t p)
{
    u128 x = 0;
    for (int bit = 68; bit >= 0; bit--)
        if (!power_exceeds(x | (u128)1 << bit, k, p))
            x |= (u128)1 << bit;
    return (uint64_t)x;
}

static uint64_t rotate(uint64_t x, int n)
{
    return x >> n | x << (64 - n);
}

static void sha512_block(uint64_t H[8], const uint64_t K[80], const unsigned char *block)
{
    uint64_t w[80], s[8];
    for (int t = 0; t < 16; t++) {
        w[t] = 0;
        for (int i = 0; i < 8; i++)
            w[t] = w[t] << 8 | block[8 * t + i];
    }
    for (int t = 16; t < 80; t++)
        w[t] = w[t - 16] + (rotate(w[t - 15], 1) ^ rotate(w[t - 15], 8) ^ w[t - 15] >> 7) + w[t - 7] +
               (rotate(w[t - 2], 19) ^ rotate(w[t - 2], 61) ^ w[t - 2] >> 6);
    memcpy(s, H, sizeof(s));
    for (int t = 0; t < 80; t++) {
        const uint64_t t1 = s[7] + (rotate(s[4], 14) ^ rotate(s[4], 18) ^ rotate(s[4], 41)) +
                            ((s[4] & s[5]) ^ (~s[4] & s[6])) + K[t] + w[t];
        const uint64_t t2 = (rotate(s[0], 28) ^ rotate(s[0], 34) ^ rotate(s[0], 39)) +
                            ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        memmove(s + 1, s, 7 * sizeof(s[0]));
        s[4] += t1;
        s[0] = t1 + t2;
    }
    for (int i = 0; i < 8; i++)
        H[i] += s[i];
}

static void sha512(const unsigned char *bytes, size_t n, unsigned char out[64])
{
    uint64_t H[8], K[80];
    int n_primes = 0;
    for (uint32_t p = 2; n_primes < 80; p++) {
        int prime = 1;
        for (uint32_t q = 2; q * q <= p; q++)
            prime &= p % q != 0;
        if (!prime)
            continue;
        if (n_primes < 8)
            H[n_primes] = root_fraction(2, p);
        K[n_primes++] = root_fraction(3, p);
    }
    size_t i = 0;
    for (; n - i >= 128; i += 128)
        sha512_block(H, K, bytes + i);
    unsigned char tail[256] = { 0 };
    const size_t rest = n - i, blocks = rest < 112 ? 1 : 2;
    memcpy(tail, bytes + i, rest);
    tail[rest] = 0x80;
    for (int b = 0; b < 8; b++)
        tail[128 * blocks - 1 - (size_t)b] = (unsigned char)((uint64_t)n * 8 >> (8 * b));
    tail[128 * blocks - 9] = (unsigned char)((uint64_t)n >> 61);
    for (size_t b = 0; b < blocks; b++)
        sha512_block(H, K, tail + 128 * b);
    for (int b = 0; b < 64; b++)
        out[b] = (unsigned char)(H[b / 8] >> (56 - 8 * (b % 8)));
}

void digest_c4(const void *bytes, size_t n, char c4[DIGEST_C4])
{
    static const char base58[] = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz";
    unsigned char number[64];
    sha512(bytes, n, number);
    c4[0] = 'c', c4[1] = '4', c4[90] = 0;
    for (int digit = 89; digit >= 2; digit--) {
        unsigned remainder = 0;
        for (int i = 0; i < 64; i++) {
            const unsigned v = remainder << 8 | number[i];
            number[i] = (unsigned char)(v / 58);
            remainder = v % 58;
        }
        c4[digit] = base58[remainder];
    }
}
