/* Preloaded: the sync number FAILED_SYNC_NUMBER (0: none) of a file whose name ends with FAILED_SYNC_FILE
   fails once, as on a disk that could not write. Each sync of it adds a byte to the file FAILED_SYNC_COUNT. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int fails(int file) {
  static int number;
  char link[64], name[4096];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, name, sizeof name - 1);
  const char *wanted = getenv("FAILED_SYNC_FILE");
  if (length < 0 || !wanted || strlen(wanted) > (size_t)length) return 0;
  name[length] = 0;
  if (strcmp(name + length - strlen(wanted), wanted) != 0) return 0;
  int now = __atomic_add_fetch(&number, 1, __ATOMIC_SEQ_CST);
  /* At once: the program may end at any moment. */
  int count = open(getenv("FAILED_SYNC_COUNT"), O_WRONLY | O_CREAT | O_APPEND, 0600);
  if (count < 0 || write(count, "+", 1) != 1) abort();
  close(count);
  if (now != atoi(getenv("FAILED_SYNC_NUMBER"))) return 0;
  errno = EIO;
  return 1;
}

#define WRAP(name)                                         \
  int name(int file) {                                     \
    if (fails(file)) return -1;                            \
    return ((int (*)(int))dlsym(RTLD_NEXT, #name))(file);  \
  }
WRAP(fsync)
WRAP(fdatasync)
