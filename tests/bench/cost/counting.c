/* Preloaded into a process under callgrind: what it says to callgrind, and a clock that is slow, as the process is. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <time.h>
#include <valgrind/callgrind.h>

#define COLD_BYTES (4 << 20)
#define LINE_BYTES 64

static volatile unsigned char cold[COLD_BYTES];

/* Reads more memory than the simulated caches hold, so that they are cold. */
void cool(void)
{
    for (int at = 0; at < COLD_BYTES; at += LINE_BYTES)
        (void)cold[at];
}

void begin(void) { CALLGRIND_START_INSTRUMENTATION; }

/* Counts from now on, or no more. */
void toggle(void) { CALLGRIND_TOGGLE_COLLECT; }

/* Writes what was counted since the last time, under a name. */
void dump(const char *name) { CALLGRIND_DUMP_STATS_AT(name); }

/* By how much the clock is slower: of the environment. */
static int slower(void)
{
    static int factor;
    if (factor == 0)
        factor = getenv("COUNTING_SLOWER") == NULL ? 1 : atoi(getenv("COUNTING_SLOWER"));
    return factor;
}

/* The monotonic clock, at a fraction of its pace: no timer of a daemon expires because callgrind is slow. */
int clock_gettime(clockid_t clock, struct timespec *result)
{
    static int (*real)(clockid_t, struct timespec *);
    if (real == NULL)
        real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int status = real(clock, result);
    if (clock == CLOCK_MONOTONIC && status == 0) {
        long long ns = (result->tv_sec * 1000000000LL + result->tv_nsec) / slower();
        result->tv_sec = ns / 1000000000LL;
        result->tv_nsec = ns % 1000000000LL;
    }
    return status;
}

int epoll_wait(int fd, struct epoll_event *events, int most, int timeout_ms)
{
    static int (*real)(int, struct epoll_event *, int, int);
    if (real == NULL)
        real = (int (*)(int, struct epoll_event *, int, int))dlsym(RTLD_NEXT, "epoll_wait");
    return real(fd, events, most, timeout_ms > 0 ? timeout_ms * slower() : timeout_ms);
}
