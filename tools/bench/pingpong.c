/* A ping-pong of CAN frames between two processes: what the system alone costs, beside Python.
 *
 *     pingpong FD FD ROUNDS WINDOWS
 *
 * Both descriptors keep the borders of what is written (a raw CAN socket, a SOCK_SEQPACKET pair). First
 * ROUNDS frames go there and back one by one, then WINDOWS windows of WINDOW frames, each answered by
 * one frame. Prints the round trips in ns, a line each, then the seconds that the windows took.
 */
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { WINDOW = 64, FRAME_BYTES = 16 };

static unsigned char frame[FRAME_BYTES] = {0x23, 0x01, 0, 0, 8};

static void put(int fd) {
    if (write(fd, frame, FRAME_BYTES) != FRAME_BYTES) {
        perror("pingpong: write");
        exit(1);
    }
}

static void take(int fd, long count) {
    unsigned char taken[FRAME_BYTES];
    while (count--)
        if (read(fd, taken, FRAME_BYTES) != FRAME_BYTES) {
            perror("pingpong: read");
            exit(1);
        }
}

static long long now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

int main(int count, char **words) {
    if (count != 5)
        return 2;
    int here = atoi(words[1]), there = atoi(words[2]);
    long rounds = atol(words[3]), windows = atol(words[4]);
    pid_t child = fork();
    if (child == 0) {
        for (long i = 0; i < rounds; i++) {
            take(there, 1);
            put(there);
        }
        for (long i = 0; i < windows; i++) {
            take(there, WINDOW);
            put(there);
        }
        _exit(0);
    }
    long long *trips = calloc(rounds, sizeof *trips);
    if (child < 0 || trips == NULL)
        return 1;
    for (long i = 0; i < rounds; i++) {
        long long start = now_ns();
        put(here);
        take(here, 1);
        trips[i] = now_ns() - start;
    }
    long long start = now_ns();
    for (long i = 0; i < windows; i++) {
        for (int n = 0; n < WINDOW; n++)
            put(here);
        take(here, 1);
    }
    long long end = now_ns();
    for (long i = 0; i < rounds; i++)
        printf("%lld\n", trips[i]);
    printf("%.9f\n", (end - start) * 1e-9);
    return waitpid(child, NULL, 0) == child ? 0 : 1;
}
