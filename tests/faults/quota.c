/* A quota on the files below a folder, for tests: loaded into every process of a run (LD_PRELOAD), it lets so many bytes be
   written there and then says EDQUOT, as a file system does whose user has used up their share.

   QUOTA_FOLDER  the folder;  QUOTA_FILE  a file of eight bytes that all processes share: what is left
*/
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/uio.h>
#include <unistd.h>

static _Atomic long *left_(void) {
  static _Atomic long *left;
  if (!left) {
    int file = open(getenv("QUOTA_FILE"), O_RDWR);
    void *at = mmap(NULL, sizeof(long), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    left = at == MAP_FAILED ? NULL : at;
  }
  return left;
}

static int counted(int file) {
  const char *folder = getenv("QUOTA_FOLDER");
  char link[64], path[4096];
  if (!folder || !getenv("QUOTA_FILE")) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return !strncmp(path, folder, strlen(folder));
}

/* How many of `count` bytes may be written; -1 with errno where none may. */
static ssize_t allowed(int file, size_t count) {
  if (!count || !counted(file) || !left_()) return count;
  long before = atomic_fetch_sub(left_(), (long)count);
  if (before >= (long)count) return count;
  atomic_fetch_add(left_(), (long)count);
  errno = EDQUOT;
  return -1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int file, const void *data, size_t count) {
  return allowed(file, count) < 0 ? -1 : REAL(write)(file, data, count);
}
ssize_t pwrite(int file, const void *data, size_t count, off_t at) {
  return allowed(file, count) < 0 ? -1 : REAL(pwrite)(file, data, count, at);
}
ssize_t pwrite64(int file, const void *data, size_t count, off64_t at) {
  return allowed(file, count) < 0 ? -1 : REAL(pwrite64)(file, data, count, at);
}
ssize_t sendfile(int to, int from, off_t *at, size_t count) {
  return allowed(to, count) < 0 ? -1 : REAL(sendfile)(to, from, at, count);
}
ssize_t sendfile64(int to, int from, off64_t *at, size_t count) {
  return allowed(to, count) < 0 ? -1 : REAL(sendfile64)(to, from, at, count);
}
