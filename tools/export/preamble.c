/* What C leaves open is settled here. A right shift of a negative number is implementation-defined
 * (C99 6.5.7): it has to be arithmetic, as in every compiler that this is meant for. A store to 32
 * or 16 bits never gets a number outside of them, by the contract of every function. */
ATO_ASSERT((INT64_C(-5) >> 1) == INT64_C(-3), arithmetic_right_shift);

/* Python's min, max, abs. */
static int64_t min64(int64_t a, int64_t b) { return b < a ? b : a; }
static int64_t max64(int64_t a, int64_t b) { return b > a ? b : a; }
static int64_t abs64(int64_t a) { return a < 0 ? -a : a; }

/* Python's division rounds down where C rounds towards 0; a divisor of 0 gives 0. */
static int64_t floor_div(int64_t a, int64_t b)
{
    int64_t quotient;

    if (b == 0 || (b == -1 && a == INT64_MIN)) {
        return 0;
    }
    quotient = a / b;
    return (a % b != 0 && (a < 0) != (b < 0)) ? quotient - 1 : quotient;
}

/* Python's `%` has the sign of the divisor; a divisor of 0 gives 0. */
static int64_t floor_mod(int64_t a, int64_t b)
{
    int64_t rest;

    if (b == 0 || b == -1) {
        return 0;
    }
    rest = a % b;
    return (rest != 0 && (rest < 0) != (b < 0)) ? rest + b : rest;
}

/* Python's `<<` for 0 <= bits <= 62: C does not define it for a negative number. */
static int64_t shift_left(int64_t a, int64_t bits) { return a * (INT64_C(1) << bits); }

/* Place of a word in the learning memory. */
static int64_t cell_at(int64_t generation, int64_t cell, int64_t word)
{
    return (generation * ATO_CELLS + cell) * ATO_WORDS + word;
}

