/* ptrace for a guest kernel that knows fewer registers than the processor has, as Linux 6.1 on one with AMX.
 * It writes its processes' registers back without those that it does not know, which the host's kernel refuses (EFAULT):
 * here they go back together with the others, as they are. */
#define _GNU_SOURCE
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

long ptrace(enum __ptrace_request request, ...) {
  static char all[1 << 16];
  static struct iovec whole = {.iov_base = all};
  va_list arguments;
  va_start(arguments, request);
  pid_t process = va_arg(arguments, pid_t);
  void *address = va_arg(arguments, void *);
  void *data = va_arg(arguments, void *);
  va_end(arguments);
  long word = 0;
  if (request == PTRACE_PEEKTEXT || request == PTRACE_PEEKDATA || request == PTRACE_PEEKUSER)
    return syscall(SYS_ptrace, request, process, address, &word) < 0 ? -1 : word;
  if (request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE) {
    const struct iovec *known = data;
    whole.iov_len = sizeof all;
    if (syscall(SYS_ptrace, PTRACE_GETREGSET, process, address, &whole) < 0) return -1;
    if (known->iov_len < whole.iov_len) {
      memcpy(all, known->iov_base, known->iov_len);
      data = &whole;
    }
  }
  return syscall(SYS_ptrace, request, process, address, data);
}
