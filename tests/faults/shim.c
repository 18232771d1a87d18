/* Stands between a process and its files and clock (LD_PRELOAD), for tests of faults.

   Of files below FAULTS_ROOT it keeps a journal in FAULTS_JOURNAL (if given): what was opened, written, cut, renamed,
   removed and synced, in the order in which it was done, over all processes. The page FAULTS_CONTROL, which a test
   maps too, says which calls fail, with what error, and how far the wall clock is off. Journal records: seven int64
   (operation, handle, offset or length, flags, bytes of the first name, of the second, of the data), then these. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { OPEN = 1, WRITE, SYNC, CUT, RENAME, UNLINK, MKDIR };
enum { CLOCK_NS, ERRNO, WRITE_EVERY, SYNC_EVERY, RENAME_EVERY, OPEN_EVERY, ONLY_LOG, BIG_MAPS, COUNT, FAILED, HANG };

#define FILES 4096
static int64_t nothing[16], *control = nothing;
static int64_t handle_of[FILES]; /* 0: not one of ours */
static char starved[FILES], is_log[FILES];
static int64_t handles;
static int journal = -1;
static const char *root;
static size_t root_length;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

#define REAL(name) ({ static __typeof__(&name) real; if (!real) real = dlsym(RTLD_NEXT, #name); real; })

__attribute__((constructor)) static void begin(void) {
    char *page = getenv("FAULTS_CONTROL"), *kept = getenv("FAULTS_JOURNAL");
    root = getenv("FAULTS_ROOT");
    root_length = root ? strlen(root) : 0;
    if (page) {
        int fd = REAL(open)(page, O_RDWR | O_CLOEXEC);
        void *at = REAL(mmap)(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
        if (fd < 0 || at == MAP_FAILED) abort();
        control = at;
        REAL(close)(fd);
    }
    if (kept) journal = REAL(open)(kept, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
    handles = (int64_t)getpid() << 32;
}

static int ours(const char *path) {
    return root && path && !strncmp(path, root, root_length) && (!path[root_length] || path[root_length] == '/');
}

static int in_log(const char *path) { return strstr(path, ".mcap") != NULL || strstr(path, "/log") != NULL; }

static void note(int64_t what, int64_t handle, int64_t number, int64_t flags, const char *a, const char *b,
                 const void *data, size_t length) {
    if (journal < 0) return;
    int64_t head[7] = {what, handle, number, flags, a ? strlen(a) : 0, b ? strlen(b) : 0, length};
    struct iovec parts[4] = {{head, sizeof head}, {(void *)a, head[4]}, {(void *)b, head[5]}, {(void *)data, length}};
    if (REAL(writev)(journal, parts, 4) < 0) abort();
}

static int spared(int log) { return (control[ONLY_LOG] == 1 && !log) || (control[ONLY_LOG] == 2 && log); }

/* Whether this call is one that the test wants to fail. */
static int fails(int which, int log) {
    int64_t every = __atomic_load_n(&control[which], __ATOMIC_SEQ_CST);
    if (!every || spared(log)) return 0;
    if (__atomic_add_fetch(&control[COUNT], 1, __ATOMIC_SEQ_CST) % every) return 0;
    __atomic_add_fetch(&control[FAILED], 1, __ATOMIC_SEQ_CST);
    errno = (int)control[ERRNO];
    return 1;
}

static int64_t tracked(int fd) { return fd >= 0 && fd < FILES ? handle_of[fd] : 0; }

static int opened(int at, const char *path, int flags, mode_t mode) {
    int creates = flags & O_CREAT && access(path, F_OK) != 0;
    if (creates && fails(OPEN_EVERY, in_log(path))) return -1;
    pthread_mutex_lock(&lock);
    int fd = REAL(openat)(at, path, flags, mode);
    if (fd >= 0 && fd < FILES) {
        handle_of[fd] = ++handles;
        starved[fd] = 0;
        is_log[fd] = in_log(path);
        note(OPEN, handle_of[fd], creates, flags & O_TRUNC ? 1 : 0, path, NULL, NULL, 0);
    }
    pthread_mutex_unlock(&lock);
    return fd;
}

#define OPENER(name, at, declared, ...)                                                                       \
    int name(declared const char *path, int flags, ...) {                                                     \
        mode_t mode = 0;                                                                                      \
        if (flags & (O_CREAT | O_TMPFILE)) {                                                                  \
            va_list list;                                                                                     \
            va_start(list, flags);                                                                            \
            mode = va_arg(list, mode_t);                                                                      \
            va_end(list);                                                                                     \
        }                                                                                                     \
        return ours(path) ? opened(at, path, flags, mode) : REAL(openat)(at, path, flags, mode);              \
    }
#define NONE
#define AT int at,
OPENER(open, AT_FDCWD, NONE)
OPENER(open64, AT_FDCWD, NONE)
OPENER(openat, at, AT)
OPENER(openat64, at, AT)

int close(int fd) {
    if (fd >= 0 && fd < FILES) handle_of[fd] = 0;
    return REAL(close)(fd);
}

/* A disk that is stuck: 1, its syncs; 2, its writes; 3, both. */
static void stuck(int fd, int64_t what) {
    while (tracked(fd) && !spared(is_log[fd]) && __atomic_load_n(&control[HANG], __ATOMIC_SEQ_CST) & what) usleep(10000);
}

/* A full disk takes a part, and nothing after it; other faults take nothing. */
static ssize_t written(int fd, const void *data, size_t length, off_t offset, int at_offset) {
    stuck(fd, 2);
    if (starved[fd]) {
        starved[fd] = 0;
        errno = (int)control[ERRNO];
        return -1;
    }
    if (fails(WRITE_EVERY, is_log[fd])) {
        if (control[ERRNO] != ENOSPC || length < 2) return -1;
        starved[fd] = 1;
        length /= 2;
    }
    pthread_mutex_lock(&lock);
    if (!at_offset) offset = lseek(fd, 0, SEEK_CUR);
    ssize_t done = at_offset ? REAL(pwrite64)(fd, data, length, offset) : REAL(write)(fd, data, length);
    if (done > 0) note(WRITE, handle_of[fd], offset, 0, NULL, NULL, data, done);
    pthread_mutex_unlock(&lock);
    return done;
}

ssize_t write(int fd, const void *data, size_t length) {
    return tracked(fd) ? written(fd, data, length, 0, 0) : REAL(write)(fd, data, length);
}
ssize_t pwrite64(int fd, const void *data, size_t length, off64_t offset) {
    return tracked(fd) ? written(fd, data, length, offset, 1) : REAL(pwrite64)(fd, data, length, offset);
}

/* The spill file's; glibc has the second, which Python takes where it can. No power cut needs them: it is made anew. */
ssize_t pwritev64(int fd, const struct iovec *parts, int number, off64_t offset) {
    stuck(fd, 2);
    return REAL(pwritev64)(fd, parts, number, offset);
}
ssize_t pwritev64v2(int fd, const struct iovec *parts, int number, off64_t offset, int flags) {
    stuck(fd, 2);
    return REAL(pwritev64v2)(fd, parts, number, offset, flags);
}

static int synced(int fd, int only_data) {
    stuck(fd, 1);
    if (tracked(fd) && fails(SYNC_EVERY, is_log[fd])) return -1;
    if (!tracked(fd)) return only_data ? REAL(fdatasync)(fd) : REAL(fsync)(fd);
    pthread_mutex_lock(&lock);
    int done = only_data ? REAL(fdatasync)(fd) : REAL(fsync)(fd);
    if (!done) note(SYNC, handle_of[fd], 0, 0, NULL, NULL, NULL, 0);
    pthread_mutex_unlock(&lock);
    return done;
}
int fsync(int fd) { return synced(fd, 0); }
int fdatasync(int fd) { return synced(fd, 1); }

int ftruncate64(int fd, off64_t length) {
    if (!tracked(fd)) return REAL(ftruncate64)(fd, length);
    pthread_mutex_lock(&lock);
    int done = REAL(ftruncate64)(fd, length);
    if (!done) note(CUT, handle_of[fd], length, 0, NULL, NULL, NULL, 0);
    pthread_mutex_unlock(&lock);
    return done;
}

#define ONE_NAME(name, declared, passed, what, number)                                                        \
    int name(const char *path declared) {                                                                     \
        if (!ours(path)) return REAL(name)(path passed);                                                      \
        pthread_mutex_lock(&lock);                                                                            \
        int done = REAL(name)(path passed);                                                                   \
        if (!done) note(what, 0, number, 0, path, NULL, NULL, 0);                                             \
        pthread_mutex_unlock(&lock);                                                                          \
        return done;                                                                                          \
    }
#define COMMA ,
ONE_NAME(truncate64, COMMA off64_t length, COMMA length, CUT, length)
ONE_NAME(unlink, NONE, NONE, UNLINK, 0)
ONE_NAME(mkdir, COMMA mode_t mode, COMMA mode, MKDIR, 0)

int rename(const char *from, const char *to) {
    if (!ours(to)) return REAL(rename)(from, to);
    if (fails(RENAME_EVERY, in_log(to))) return -1;
    pthread_mutex_lock(&lock);
    int done = REAL(rename)(from, to);
    if (!done) note(RENAME, 0, 0, 0, from, to, NULL, 0);
    pthread_mutex_unlock(&lock);
    return done;
}

/* Only the wall clock jumps; the monotonic one can't. */
int clock_gettime(clockid_t clock, struct timespec *now) {
    int done = REAL(clock_gettime)(clock, now);
    if (!done && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        int64_t off = __atomic_load_n(&control[CLOCK_NS], __ATOMIC_SEQ_CST);
        int64_t ns = now->tv_nsec + off % 1000000000;
        now->tv_sec += off / 1000000000 + (ns < 0 ? -1 : ns >= 1000000000);
        now->tv_nsec = ns < 0 ? ns + 1000000000 : ns >= 1000000000 ? ns - 1000000000 : ns;
    }
    return done;
}
time_t time(time_t *out) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}
int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec t;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &t);
    now->tv_sec = t.tv_sec;
    now->tv_usec = t.tv_nsec / 1000;
    return 0;
}

/* Python's mmap, which is where memory for tiles comes from. */
void *mmap64(void *at, size_t length, int kind, int flags, int fd, off64_t offset) {
    if (control[BIG_MAPS] && fd < 0 && length >= (size_t)1 << 20) {
        __atomic_add_fetch(&control[FAILED], 1, __ATOMIC_SEQ_CST);
        errno = ENOMEM;
        return MAP_FAILED;
    }
    return REAL(mmap64)(at, length, kind, flags, fd, offset);
}
