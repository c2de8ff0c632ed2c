/* A disk that fails, and a wall clock that jumps: preloaded into a process, it stands between it and one folder.

   DISK_SHIM_FOLDER: the folder. Files below it that are shared memory (-shm) are left alone.
   DISK_SHIM_LOG:    a file to which all that is done to the folder is appended, in the order in which it was done.
   DISK_SHIM_FAULTS: a file that holds a `struct faults`; it may be changed while the process runs.

   A record of the log is a `struct record`, a name and data. Files are told apart by their inode. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum operation { WRITE = 1, TRUNCATE, SYNC, SYNC_FOLDER, CREATE, RENAME, UNLINK, LINK };
enum kind { NOT_OURS, A_FILE, THE_FOLDER };
enum { FILES = 1024 };
struct faults { int32_t write_errno, slow_ms; int64_t clock_s; };
struct record { uint32_t operation, name_size; uint64_t inode, offset, data_size; };

static const struct faults none;
static const struct faults *faults = &none;
static char folder[PATH_MAX];
static size_t folder_size;
static int log_fd = -1;
static unsigned char kinds[FILES];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

__attribute__((constructor)) static void begin(void) {
    const char *where = getenv("DISK_SHIM_FOLDER"), *log = getenv("DISK_SHIM_LOG"), *file = getenv("DISK_SHIM_FAULTS");
    if (where && realpath(where, folder)) folder_size = strlen(folder);
    if (log) log_fd = (int)syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
    int fd = file ? (int)syscall(SYS_openat, AT_FDCWD, file, O_RDONLY | O_CLOEXEC, 0) : -1;
    if (fd < 0) return;
    void *held = mmap(NULL, sizeof *faults, PROT_READ, MAP_SHARED, fd, 0);
    if (held != MAP_FAILED) faults = held;
    syscall(SYS_close, fd);
}

/* --- what is ours */

static int is_memory(const char *name) {
    size_t size = strlen(name);
    return size > 4 && strcmp(name + size - 4, "-shm") == 0;
}

/* The name of a file in the folder; NULL for all others. "" is the folder itself. */
static const char *name_in_folder(const char *path) {
    if (!folder_size || !path || strncmp(path, folder, folder_size) != 0) return NULL;
    const char *rest = path + folder_size;
    if (*rest == 0) return rest;
    if (*rest != '/' || strchr(rest + 1, '/') || is_memory(rest)) return NULL;
    return rest + 1;
}

static enum kind kind_of(int fd) { return fd >= 0 && fd < FILES ? kinds[fd] : NOT_OURS; }

static uint64_t inode_of(int fd) {
    struct stat info;
    return fstat(fd, &info) == 0 ? (uint64_t)info.st_ino : 0;
}

/* --- the log and the faults; `lock` is held, so that the log has the order of what is done */

static void note(enum operation operation, uint64_t inode, uint64_t offset, const char *name, const void *data,
                 size_t size) {
    if (log_fd < 0) return;
    int before = errno;
    struct record record = {operation, (uint32_t)strlen(name), inode, offset, size};
    struct iovec parts[] = {{&record, sizeof record}, {(void *)name, record.name_size}, {(void *)data, size}};
    if (syscall(SYS_writev, log_fd, parts, 3) < 0) abort();
    errno = before;
}

static int refused(void) {
    if (faults->slow_ms) {
        struct timespec wait = {faults->slow_ms / 1000, faults->slow_ms % 1000 * 1000000L};
        nanosleep(&wait, NULL);
    }
    if (faults->write_errno) errno = faults->write_errno;
    return faults->write_errno != 0;
}

/* --- files */

static int opened(const char *path, int flags, mode_t mode) {
    const char *name = name_in_folder(path);
    if (!name) return (int)syscall(SYS_openat, AT_FDCWD, path, flags, mode);
    pthread_mutex_lock(&lock);
    int is_new = (flags & O_CREAT) && access(path, F_OK) != 0, fd = -1;
    if (!(is_new && refused())) fd = (int)syscall(SYS_openat, AT_FDCWD, path, flags, mode);
    if (fd >= 0 && fd < FILES) {
        kinds[fd] = *name ? A_FILE : THE_FOLDER;
        if (is_new) note(CREATE, inode_of(fd), 0, name, NULL, 0);
        else if (flags & O_TRUNC) note(TRUNCATE, inode_of(fd), 0, name, NULL, 0);
    }
    pthread_mutex_unlock(&lock);
    return fd;
}

#define MODE_OF(flags) \
    mode_t mode = 0; \
    if ((flags) & (O_CREAT | __O_TMPFILE)) { \
        va_list rest; \
        va_start(rest, flags); \
        mode = va_arg(rest, mode_t); \
        va_end(rest); \
    }

int open(const char *path, int flags, ...) { MODE_OF(flags) return opened(path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE_OF(flags) return opened(path, flags, mode); }

static int opened_at(int at, const char *path, int flags, mode_t mode) {
    if (at == AT_FDCWD || *path == '/') return opened(path, flags, mode);
    return (int)syscall(SYS_openat, at, path, flags, mode);
}

int openat(int at, const char *path, int flags, ...) { MODE_OF(flags) return opened_at(at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE_OF(flags) return opened_at(at, path, flags, mode); }

int close(int fd) {
    if (fd >= 0 && fd < FILES) kinds[fd] = NOT_OURS;
    return (int)syscall(SYS_close, fd);
}

static ssize_t written(int fd, const void *data, size_t size, off_t offset, int has_offset) {
    if (kind_of(fd) != A_FILE)
        return has_offset ? syscall(SYS_pwrite64, fd, data, size, offset) : syscall(SYS_write, fd, data, size);
    pthread_mutex_lock(&lock);
    ssize_t done = -1;
    if (!refused()) {
        done = has_offset ? syscall(SYS_pwrite64, fd, data, size, offset) : syscall(SYS_write, fd, data, size);
        off_t at = has_offset ? offset : lseek(fd, 0, SEEK_CUR) - (done > 0 ? done : 0);
        if (done > 0) note(WRITE, inode_of(fd), (uint64_t)at, "", data, (size_t)done);
    }
    pthread_mutex_unlock(&lock);
    return done;
}

ssize_t write(int fd, const void *data, size_t size) { return written(fd, data, size, 0, 0); }
ssize_t pwrite(int fd, const void *data, size_t size, off_t offset) { return written(fd, data, size, offset, 1); }
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset) { return written(fd, data, size, offset, 1); }

static int truncated(int fd, off_t size) {
    if (kind_of(fd) != A_FILE) return (int)syscall(SYS_ftruncate, fd, size);
    pthread_mutex_lock(&lock);
    int done = refused() ? -1 : (int)syscall(SYS_ftruncate, fd, size);
    if (done == 0) note(TRUNCATE, inode_of(fd), (uint64_t)size, "", NULL, 0);
    pthread_mutex_unlock(&lock);
    return done;
}

int ftruncate(int fd, off_t size) { return truncated(fd, size); }
int ftruncate64(int fd, off64_t size) { return truncated(fd, size); }

static int synced(int fd, long call) {
    if (kind_of(fd) == NOT_OURS) return (int)syscall(call, fd);
    pthread_mutex_lock(&lock);
    int done = refused() ? -1 : (int)syscall(call, fd);
    if (done == 0) note(kind_of(fd) == THE_FOLDER ? SYNC_FOLDER : SYNC, inode_of(fd), 0, "", NULL, 0);
    pthread_mutex_unlock(&lock);
    return done;
}

int fsync(int fd) { return synced(fd, SYS_fsync); }
int fdatasync(int fd) { return synced(fd, SYS_fdatasync); }

/* --- names */

static int renamed(enum operation operation, const char *from, const char *to) {
    const char *old = name_in_folder(from), *new = name_in_folder(to);
    int hard = operation == LINK, done = -1, ours = old && new;
    if (ours) pthread_mutex_lock(&lock);
    if (!(ours && refused()))
        done = hard ? (int)syscall(SYS_linkat, AT_FDCWD, from, AT_FDCWD, to, 0)
                    : (int)syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0);
    if (ours && done == 0) note(operation, 0, 0, old, new, strlen(new));
    if (ours) pthread_mutex_unlock(&lock);
    return done;
}

int rename(const char *from, const char *to) { return renamed(RENAME, from, to); }
int link(const char *from, const char *to) { return renamed(LINK, from, to); }

int unlink(const char *path) {
    const char *name = name_in_folder(path);
    if (name) pthread_mutex_lock(&lock);
    int done = name && refused() ? -1 : (int)syscall(SYS_unlinkat, AT_FDCWD, path, 0);
    if (name && done == 0) note(UNLINK, 0, 0, name, NULL, 0);
    if (name) pthread_mutex_unlock(&lock);
    return done;
}

/* --- the wall clock */

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int done = real(clock, now);
    if (done == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += faults->clock_s;
    return done;
}

int gettimeofday(struct timeval *now, void *zone) {
    (void)zone;
    struct timespec t;
    if (clock_gettime(CLOCK_REALTIME, &t) != 0) return -1;
    now->tv_sec = t.tv_sec;
    now->tv_usec = t.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *kept) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    if (kept) *kept = t.tv_sec;
    return t.tv_sec;
}
