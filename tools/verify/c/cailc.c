/* CAILC of controller/laws/cailc.py, and a loop over rows of inputs. SIN_n: the coefficients of controller/q.py. */
#include "ato.h"

#define FAULT_BARRIER (1 << 8)

struct params {
	int32_t alpha, beta, gamma[3], nu_b, inverse_nu_b, s_min, theta_min[3], theta_max[3];
	int32_t force_max, padding;
};

struct state {
	int32_t delta, chi;
};

static int64_t sin_half_pi(int64_t s)
{
	int64_t square = (s * s) >> 30;
	int64_t series = SIN_5 + ((SIN_7 * square) >> 30);

	series = SIN_3 + ((series * square) >> 30);
	series = SIN_1 + ((series * square) >> 30);
	return round_shift(series * s, 28);
}

static int64_t barrier(int64_t delta, int64_t nu_b, int64_t inverse_nu_b, int64_t s_min)
{
	int64_t ratio = (clamp(delta, -nu_b, nu_b) * inverse_nu_b) >> 10;
	int64_t r = (ratio * ratio) >> 30;
	int64_t sine = sin_half_pi(max64(((int64_t)1 << 30) - r, s_min));
	int64_t square = (sine * sine) >> 30;

	return sat32(floor_div(delta * ((int64_t)1 << 30), max64(square, 1)));
}

static void cailc(const struct params *p, struct state *s, struct cell *c, const struct inputs *in,
		  struct outputs *out)
{
	const int64_t v_max = (int64_t)1 << 27, chi_v2_max = (int64_t)1 << 37;
	int64_t e = clamp(((int64_t)in->position - in->reference_position) * 512,
			  -((int64_t)1 << 28), (int64_t)1 << 28);
	int64_t ed = sat32((int64_t)in->speed - in->reference_speed);
	int64_t delta = sat32(round_shift(p->alpha * e, 16) + ed);
	int64_t speed = clamp((int64_t)in->speed >> 2, -v_max, v_max);
	int64_t chi = barrier(delta, p->nu_b, p->inverse_nu_b, p->s_min);
	int64_t chi_v = round_shift(chi * speed, 22);
	int64_t chi_v2 = clamp(round_shift(chi_v * speed, 22), -chi_v2_max, chi_v2_max);

	s->delta = (int32_t)delta;
	s->chi = (int32_t)chi;
	c->learn[0] = (int32_t)sat32(-round_shift(chi * p->gamma[0], 20));
	c->learn[1] = (int32_t)sat32(-round_shift(chi_v * p->gamma[1], 28));
	c->learn[2] = (int32_t)sat32(-round_shift(chi_v2 * p->gamma[2], 30));

	int64_t theta[3];

	for (int q = 0; q < 3; q++)
		theta[q] = clamp((int64_t)c->before[q] + c->learn[q], p->theta_min[q], p->theta_max[q]);

	int64_t v2 = (speed * speed) >> 28;
	int64_t resistance = round_shift(theta[0], 7) + round_shift(theta[1] * speed, 34) +
			     round_shift(theta[2] * v2, 32);
	int64_t damping = round_shift(p->alpha * ed, 13) + round_shift(p->beta * delta, 21);

	out->force = (int32_t)clamp(resistance + in->ahead_acceleration - damping,
				    -(int64_t)p->force_max, p->force_max);
	out->status = abs64(delta) >= p->nu_b ? FAULT_BARRIER : 0;
	for (int q = 0; q < 3; q++)
		out->estimate[q] = (int32_t)theta[q];
	out->estimate[3] = (int32_t)delta;
	out->estimate[4] = (int32_t)chi;
}

void cailc_loop(int64_t n, const struct params *p, struct state *s, struct cell *c,
		const struct inputs *in, struct outputs *out)
{
	for (int64_t k = 0; k < n; k++)
		cailc(p, s, &c[k], &in[k], &out[k]);
}
