/* Preloaded into linux.uml: lets user-mode Linux of Debian 12 run on processors with AMX.
 *
 * That kernel (6.1) saves 2.7 KB of floating-point state of a process. Where the processor has more,
 * the host refuses to set a part of the state (EFAULT), and the guest panics at its first process.
 * Here the rest of the state is left to the process as it is.
 */
#define _GNU_SOURCE
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

static long call(long request, long pid, long address, void *data) {
    return syscall(SYS_ptrace, request, pid, address, data);
}

long ptrace(enum __ptrace_request request, ...) {
    va_list arguments;
    va_start(arguments, request);
    long pid = va_arg(arguments, pid_t);
    long address = va_arg(arguments, long);
    void *data = va_arg(arguments, void *);
    va_end(arguments);
    if (request < 4 && request > 0) { /* PEEK: the system call stores what the library returns */
        long word = 0;
        return call(request, pid, address, &word) < 0 ? -1 : word;
    }
    if (request != PTRACE_SETREGSET || address != NT_X86_XSTATE)
        return call(request, pid, address, data);
    static char whole[1 << 16];
    struct iovec part = *(struct iovec *)data;
    struct iovec all = {whole, sizeof whole};
    if (call(PTRACE_GETREGSET, pid, address, &all) < 0)
        return -1;
    memcpy(whole, part.iov_base, part.iov_len < all.iov_len ? part.iov_len : all.iov_len);
    return call(request, pid, address, &all);
}
