#include "ato.h"
#include "ato_vectors.h"

static ato_state state;
static ato_word memory_cells[2 * ATO_CELLS * ATO_WORDS];
static ato_mailbox rx[ATO_MESSAGE_COUNT];
static ato_mailbox tx[ATO_MESSAGE_COUNT];

/* FNV-1a over the eight bytes of a number, the lowest first. */
static uint64_t digested(uint64_t digest, int64_t number)
{
    uint64_t bits = (uint64_t)number;

    for (int i = 0; i < 8; i++) {
        digest = (digest ^ (bits & 255u)) * UINT64_C(1099511628211);
        bits >>= 8;
    }
    return digest;
}

/* Number of the first call that does not give the frames of the vectors, from 1; -1 if the digest
 * differs; 0 if all is as it should be. */
int32_t ato_selftest(void)
{
    uint64_t digest = UINT64_C(14695981039346656037);
    size_t in = 0;
    size_t out = 0;

    ato_init(&ATO_PARAMS[0], &state, memory_cells);
    for (int32_t call = 0; call < ATO_VECTOR_CALLS; call++) {
        for (size_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            rx[i].fresh = 0;
            tx[i].fresh = 0;
        }
        for (int k = 0; k < vector_calls[call].received; k++, in++) {
            rx[vector_in[in].message].payload = vector_in[in].payload;
            rx[vector_in[in].message].fresh = 1;
        }
        (void)ato_cycle(&ATO_PARAMS[0], ATO_PROFILE, &state, memory_cells, rx, tx,
            vector_calls[call].period);
        for (size_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            if (tx[i].fresh != 0) {
                if (out >= ATO_VECTOR_OUT || vector_out[out].message != i ||
                    vector_out[out].payload != tx[i].payload) {
                    return call + 1;
                }
                digest = digested(digest, tx[i].payload);
                out++;
            }
        }
    }
    for (size_t i = 0; i < sizeof memory_cells / sizeof memory_cells[0]; i++) {
        digest = digested(digest, memory_cells[i]);
    }
    return (out == ATO_VECTOR_OUT && digest == ATO_VECTOR_DIGEST) ? 0 : -1;
}

#ifndef ATO_SELFTEST_ALONE /* a target that calls ato_selftest itself defines it */
int main(void)
{
    return ato_selftest() == 0 ? 0 : 1;
}
#endif
