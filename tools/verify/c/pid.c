/* The PID of controller/laws/pid.py, and a loop over rows of inputs. */
#include "ato.h"

struct params {
	int32_t gp, gi, gd, force_max;
};

struct state {
	int64_t integral;
	int32_t last, padding;
};

static void pid(const struct params *p, struct state *s, const struct inputs *in, struct outputs *out)
{
	const int64_t integral_max = (int64_t)1 << 40;

	if (in->tick == 0) {
		s->integral = 0;
		s->last = 0;
	}
	int64_t eps = sat32((int64_t)in->reference_speed - in->speed);
	int64_t integral = clamp(s->integral + eps, -integral_max, integral_max);
	int64_t change = eps - s->last;
	int64_t wanted = round_shift(eps * p->gp, 21) + round_shift(integral * p->gi, 37) +
			 round_shift(change * p->gd, 21);

	s->integral = integral;
	s->last = (int32_t)eps;
	out->force = (int32_t)clamp(wanted, -(int64_t)p->force_max, p->force_max);
	out->status = 0;
	out->estimate[0] = (int32_t)sat32(integral >> 8);
}

void pid_loop(int64_t n, const struct params *p, struct state *s, struct cell *c,
	      const struct inputs *in, struct outputs *out)
{
	(void)c;
	for (int64_t k = 0; k < n; k++)
		pid(p, s, &in[k], &out[k]);
}
