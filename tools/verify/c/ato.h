/* What the C twins share. int32 storage, int64 intermediates, floor shifts (gcc's >> of negatives). */
#ifndef ATO_H
#define ATO_H

#include <stdint.h>

static inline int64_t min64(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t max64(int64_t a, int64_t b) { return a > b ? a : b; }
static inline int64_t abs64(int64_t a) { return a < 0 ? -a : a; }
static inline int64_t clamp(int64_t x, int64_t low, int64_t high) { return min64(max64(x, low), high); }
static inline int64_t sat32(int64_t x) { return clamp(x, INT32_MIN, INT32_MAX); }
static inline int64_t round_shift(int64_t x, int bits) { return (x + ((int64_t)1 << (bits - 1))) >> bits; }

/* Division rounds to minus infinity, as in Python. */
static inline int64_t floor_div(int64_t a, int64_t b)
{
	int64_t q = a / b;

	return (a % b != 0 && (a < 0) != (b < 0)) ? q - 1 : q;
}

struct cell {
	int32_t before[WORDS_MAX];
	int32_t learn[WORDS_MAX];
	int32_t ahead[AHEAD_WORDS];
	int32_t smooth, padding;
};

struct inputs {
	int32_t tick, iteration;
	int32_t position, speed;
	int32_t reference_position, reference_speed, reference_acceleration;
	int32_t ahead_position, ahead_speed, ahead_acceleration;
	int32_t limited, map_acceleration;
	int32_t neighbour[2], distance[2], closing[2];
};

struct outputs {
	int32_t force, status;
	int32_t estimate[10];
};

/* The records of controller/interface.py and controller/memory.py, in their sizes. */
_Static_assert(sizeof(struct cell) == CELL_BYTES, "struct cell");
_Static_assert(sizeof(struct inputs) == INPUTS_BYTES, "struct inputs");
_Static_assert(sizeof(struct outputs) == OUTPUTS_BYTES, "struct outputs");

#endif
