/* See br_hmac.h. */
#include "br_hmac.h"

#include <string.h>

static const uint32_t ROUND[64] = {
    0x428a2f98u, 0x71374491u, 0xb5c0fbcfu, 0xe9b5dba5u, 0x3956c25bu, 0x59f111f1u, 0x923f82a4u,
    0xab1c5ed5u, 0xd807aa98u, 0x12835b01u, 0x243185beu, 0x550c7dc3u, 0x72be5d74u, 0x80deb1feu,
    0x9bdc06a7u, 0xc19bf174u, 0xe49b69c1u, 0xefbe4786u, 0x0fc19dc6u, 0x240ca1ccu, 0x2de92c6fu,
    0x4a7484aau, 0x5cb0a9dcu, 0x76f988dau, 0x983e5152u, 0xa831c66du, 0xb00327c8u, 0xbf597fc7u,
    0xc6e00bf3u, 0xd5a79147u, 0x06ca6351u, 0x14292967u, 0x27b70a85u, 0x2e1b2138u, 0x4d2c6dfcu,
    0x53380d13u, 0x650a7354u, 0x766a0abbu, 0x81c2c92eu, 0x92722c85u, 0xa2bfe8a1u, 0xa81a664bu,
    0xc24b8b70u, 0xc76c51a3u, 0xd192e819u, 0xd6990624u, 0xf40e3585u, 0x106aa070u, 0x19a4c116u,
    0x1e376c08u, 0x2748774cu, 0x34b0bcb5u, 0x391c0cb3u, 0x4ed8aa4au, 0x5b9cca4fu, 0x682e6ff3u,
    0x748f82eeu, 0x78a5636fu, 0x84c87814u, 0x8cc70208u, 0x90befffau, 0xa4506cebu, 0xbef9a3f7u,
    0xc67178f2u};

static uint32_t turned(uint32_t word, int bits) { return word >> bits | word << (32 - bits); }

static uint32_t word_at(const uint8_t *b) {
    return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
}

/* Takes one block in. */
static void compress(uint32_t state[8], const uint8_t *block) {
    uint32_t w[64], a = state[0], b = state[1], c = state[2], d = state[3], e = state[4],
                    f = state[5], g = state[6], h = state[7];
    for (int i = 0; i < 16; ++i) w[i] = word_at(block + 4 * i);
    for (int i = 16; i < 64; ++i)
        w[i] = w[i - 16] + (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3) +
               w[i - 7] + (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10);
    for (int i = 0; i < 64; ++i) {
        const uint32_t first = h + (turned(e, 6) ^ turned(e, 11) ^ turned(e, 25)) +
                               ((e & f) ^ (~e & g)) + ROUND[i] + w[i];
        const uint32_t second =
            (turned(a, 2) ^ turned(a, 13) ^ turned(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
        h = g, g = f, f = e, e = d + first;
        d = c, c = b, b = a, a = first + second;
    }
    state[0] += a, state[1] += b, state[2] += c, state[3] += d;
    state[4] += e, state[5] += f, state[6] += g, state[7] += h;
}

void br_sha256_start(br_sha256 *hash) {
    static const uint32_t begin[8] = {0x6a09e667u, 0xbb67ae85u, 0x3c6ef372u, 0xa54ff53au,
                                      0x510e527fu, 0x9b05688cu, 0x1f83d9abu, 0x5be0cd19u};
    memcpy(hash->state, begin, sizeof begin);
    hash->size = 0;
}

void br_sha256_add(br_sha256 *hash, const void *data, size_t size) {
    for (const uint8_t *from = data; size;) {
        const size_t held = hash->size % BR_SHA256_BLOCK, room = BR_SHA256_BLOCK - held;
        const size_t taken = size < room ? size : room;
        memcpy(hash->block + held, from, taken);
        if (taken == room) compress(hash->state, hash->block);
        hash->size += taken;
        from += taken, size -= taken;
    }
}

void br_sha256_end(br_sha256 *hash, uint8_t digest[BR_SHA256_BYTES]) {
    static const uint8_t padding[BR_SHA256_BLOCK] = {0x80};
    const uint64_t bits = hash->size * 8;
    uint8_t length[8];
    for (int i = 0; i < 8; ++i) length[i] = (uint8_t)(bits >> (56 - 8 * i));
    br_sha256_add(hash, padding, 1 + (119 - hash->size % BR_SHA256_BLOCK) % BR_SHA256_BLOCK);
    br_sha256_add(hash, length, sizeof length);
    for (int i = 0; i < BR_SHA256_BYTES; ++i)
        digest[i] = (uint8_t)(hash->state[i / 4] >> (24 - 8 * (i % 4)));
}

static void start_padded(br_sha256 *hash, const uint8_t *block, uint8_t pad) {
    uint8_t padded[BR_SHA256_BLOCK];
    for (int i = 0; i < BR_SHA256_BLOCK; ++i) padded[i] = block[i] ^ pad;
    br_sha256_start(hash);
    br_sha256_add(hash, padded, sizeof padded);
}

void br_hmac_set_key(br_hmac *key, const uint8_t *secret, size_t size) {
    uint8_t block[BR_SHA256_BLOCK] = {0};
    if (size > sizeof block) {
        br_sha256_start(&key->inner);
        br_sha256_add(&key->inner, secret, size);
        br_sha256_end(&key->inner, block);
    } else {
        memcpy(block, secret, size);
    }
    start_padded(&key->inner, block, 0x36);
    start_padded(&key->outer, block, 0x5c);
}

void br_hmac_end(const br_hmac *key, br_sha256 *inner, uint8_t tag[BR_SHA256_BYTES]) {
    br_sha256 outer = key->outer;
    br_sha256_end(inner, tag);
    br_sha256_add(&outer, tag, BR_SHA256_BYTES);
    br_sha256_end(&outer, tag);
}
