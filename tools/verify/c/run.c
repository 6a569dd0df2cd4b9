/* Calls a compiled step once for each set of records in a file, so that an instruction counter can watch it. */
#include <stdio.h>
#include <stdlib.h>

int ato_step(void *params, void *state, void *cell, void *inputs, void *outputs);

/* run FILE SIZE...: sizes in bytes of params, state, cell, inputs, outputs; the file holds the sets one after another. */
int main(int argc, char **argv)
{
	FILE *file = argc == 7 ? fopen(argv[1], "rb") : NULL;
	void *record[5];
	size_t size[5];

	if (!file)
		return 2;
	for (int k = 0; k < 5; k++) {
		size[k] = strtoul(argv[2 + k], NULL, 10);
		record[k] = malloc(size[k] + 1);
	}
	for (;;) {
		for (int k = 0; k < 5; k++)
			if (fread(record[k], 1, size[k], file) != size[k])
				return k == 0 ? 0 : 3;
		if (ato_step(record[0], record[1], record[2], record[3], record[4]) != 0)
			return 4;
	}
}
