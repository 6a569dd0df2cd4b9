/* Codec and end-to-end check: TRAIN_SPEED decoded, FORCE_CMD encoded, and Profile 11 by one table look-up a byte. */
#include "ato.h"

struct layout {
	int64_t start, length, is_signed;
};

static int64_t get(int64_t word, const struct layout *s)
{
	int64_t raw = (word >> s->start) & (((int64_t)1 << s->length) - 1);

	if (s->is_signed) {
		int64_t sign = (int64_t)1 << (s->length - 1);

		raw = (raw ^ sign) - sign;
	}
	return raw;
}

static uint64_t put(const struct layout *s, int64_t raw)
{
	return ((uint64_t)raw & (((uint64_t)1 << s->length) - 1)) << s->start;
}

static int64_t saturate(const struct layout *s, int64_t raw)
{
	int64_t high = ((int64_t)1 << (s->length - s->is_signed)) - 1;

	return clamp(raw, s->is_signed ? -high - 1 : 0, high);
}

/* Place of a signal: from the DBC, by the compiler's command line. */
#define SPEED { SPEED_START, SPEED_LENGTH, SPEED_SIGNED }
#define QUALITY { QUALITY_START, QUALITY_LENGTH, QUALITY_SIGNED }
#define FORCE { FORCE_START, FORCE_LENGTH, FORCE_SIGNED }
#define MODE { MODE_START, MODE_LENGTH, MODE_SIGNED }
#define TICK { TICK_START, TICK_LENGTH, TICK_SIGNED }

void codec_loop(int64_t n, const int64_t *words, int64_t *out)
{
	static const struct layout speed = SPEED, quality = QUALITY, force = FORCE, mode = MODE, tick = TICK;

	for (int64_t k = 0; k < n; k++) {
		int64_t v = saturate(&force, get(words[k], &speed)), q = get(words[k], &quality);

		out[k] = (int64_t)(put(&force, v) | put(&mode, q) | put(&tick, k & 0xFFFF));
	}
}

static int64_t crc(const int16_t *table, int64_t word, int64_t seed)
{
	int64_t crc = seed;

	for (int i = 1; i < 8; i++)
		crc ^= table[256 * (7 - i) + ((word >> (8 * i)) & 0xFF)];
	return crc;
}

/* table: 7 rows of 256, then a row for the Data-ID. Protects each word and checks it as a receiver. */
void e2e_loop(int64_t n, const int16_t *table, int64_t data_id, const int64_t *words, int64_t *out)
{
	int64_t seed = table[7 * 256 + (data_id & 0xFF)];
	int64_t counter = 0, last = -1;

	for (int64_t k = 0; k < n; k++) {
		int64_t headed = words[k] + (counter << 8) + (((data_id >> 8) & 15) << 12);
		int64_t word = headed + crc(table, headed, seed);
		int64_t found = (word >> 8) & 15, verdict = 0;

		counter = counter >= 14 ? 0 : counter + 1;
		if ((word & 0xFF) != crc(table, word, seed) ||
		    ((word >> 12) & 15) != ((data_id >> 8) & 15) || found >= 15)
			verdict = 3;
		else if (last >= 0 && found == last)
			verdict = 1;
		else if (last >= 0 && found != (last >= 14 ? 0 : last + 1))
			verdict = 2;
		last = found;
		out[k] = word + verdict;
	}
}
