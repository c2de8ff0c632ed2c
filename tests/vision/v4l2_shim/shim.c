/* A V4L2 camera without a kernel: preloaded into a process, it answers the calls that go to the file of a camera.

   Such a file begins with MAGIC. Its header says what the camera can and what is wrong with it, and can be changed
   while the camera runs; behind it are the frames, encoded as they go over the wire. Frame k is due at
   (k + phase) / fps on CLOCK_MONOTONIC and is number k mod count, so what a camera shows is a function of time.
   A buffer takes the first frame that is due after it was queued, as a driver does: one that is queued late misses it.
   All other files are left to the C library. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { CONTROLS = 16, BUFFERS = 8, CAMERAS = 8, FRAMES_AT = 4096 };
enum stamps { MONOTONIC, ZERO, WALL_CLOCK };
static const char MAGIC[8] = "V4L2SHIM";
static const double PATIENCE_S = 0.005; /* between two looks at a header that may have changed */

struct control { uint32_t id, deaf; int32_t least, most, value, padding; };
struct header {
    char magic[8];
    uint32_t width, height, fourcc, count;
    double fps, told_fps, phase;
    uint32_t unplugged, stamps, torn_every, silent, served, controls;
    struct control control[CONTROLS];
};
struct place { uint64_t offset, size; };
struct camera {
    int fd; /* -1: free */
    size_t length;
    struct header *header;
    uint32_t buffers, queued, first;
    int is_streaming;
    int64_t last; /* frame that a buffer waits for, or was filled with */
    struct { void *start; size_t length; int64_t frame; } buffer[BUFFERS];
    uint32_t queue[BUFFERS];
};

static struct camera cameras[CAMERAS] = {[0 ... CAMERAS - 1] = {.fd = -1}};
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

#define REAL(name, type) ((type)dlsym(RTLD_NEXT, name))
typedef int (*open_call)(const char *, int, ...);
typedef int (*ioctl_call)(int, unsigned long, ...);
typedef int (*close_call)(int);
typedef void *(*mmap_call)(void *, size_t, int, int, int, off_t);
typedef int (*select_call)(int, fd_set *, fd_set *, fd_set *, struct timeval *);

static double now_s(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static struct camera *camera_of(int fd) {
    for (int i = 0; fd >= 0 && i < CAMERAS; i++)
        if (cameras[i].fd == fd) return &cameras[i];
    return NULL;
}

static const struct place *place_of(const struct header *h, int64_t frame) {
    const struct place *places = (const struct place *)((const char *)h + FRAMES_AT);
    return &places[frame % h->count];
}

static double due_s(const struct header *h, int64_t frame) { return ((double)frame + h->phase) / h->fps; }

static size_t largest(const struct header *h) {
    size_t size = 2u * h->width * h->height;
    for (uint32_t i = 0; i < h->count; i++)
        if (place_of(h, i)->size > size) size = place_of(h, i)->size;
    return size;
}

/* --- opening and closing */

static int opened(int fd) {
    char magic[sizeof MAGIC];
    struct stat info;
    if (fd < 0 || fstat(fd, &info) != 0 || !S_ISREG(info.st_mode)) return fd;
    if (pread(fd, magic, sizeof magic, 0) != sizeof magic || memcmp(magic, MAGIC, sizeof magic) != 0) return fd;
    pthread_mutex_lock(&lock);
    struct camera *c = NULL;
    for (int i = 0; i < CAMERAS && c == NULL; i++)
        if (cameras[i].fd < 0) c = &cameras[i];
    struct header *h = c == NULL ? MAP_FAILED
        : REAL("mmap", mmap_call)(NULL, (size_t)info.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (h == MAP_FAILED || h->unplugged) {
        if (h != MAP_FAILED) munmap(h, (size_t)info.st_size);
        pthread_mutex_unlock(&lock);
        REAL("close", close_call)(fd);
        errno = ENODEV;
        return -1;
    }
    memset(c, 0, sizeof *c);
    c->length = (size_t)info.st_size;
    c->header = h;
    c->fd = fd;
    pthread_mutex_unlock(&lock);
    return fd;
}

static mode_t mode_of(int flags, va_list rest) { return flags & O_CREAT ? (mode_t)va_arg(rest, int) : 0; }

int open(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = mode_of(flags, rest);
    va_end(rest);
    int fd = REAL("open", open_call)(path, flags, mode);
    return (flags & O_ACCMODE) == O_RDWR && (flags & O_NONBLOCK) ? opened(fd) : fd;
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = mode_of(flags, rest);
    va_end(rest);
    return open(path, flags, mode);
}

int close(int fd) {
    pthread_mutex_lock(&lock);
    struct camera *c = camera_of(fd);
    if (c != NULL) {
        munmap(c->header, c->length);
        c->fd = -1;
    }
    pthread_mutex_unlock(&lock);
    return REAL("close", close_call)(fd);
}

/* --- buffers */

static int refuse(int error) {
    errno = error;
    return -1;
}

static void describe(const struct camera *c, struct v4l2_buffer *b) {
    b->length = (uint32_t)c->buffer[b->index].length;
    b->m.offset = b->index * (uint32_t)sysconf(_SC_PAGESIZE);
    b->memory = V4L2_MEMORY_MMAP;
    b->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
}

static int request(struct camera *c, struct v4l2_requestbuffers *r) {
    for (uint32_t i = 0; i < c->buffers; i++) munmap(c->buffer[i].start, c->buffer[i].length);
    c->buffers = c->queued = c->first = 0;
    if (r->count > BUFFERS) r->count = BUFFERS;
    for (; c->buffers < r->count; c->buffers++) {
        size_t length = largest(c->header);
        void *start = REAL("mmap", mmap_call)(NULL, length, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
        if (start == MAP_FAILED) return refuse(ENOMEM);
        c->buffer[c->buffers].start = start;
        c->buffer[c->buffers].length = length;
    }
    return 0;
}

static void *map(int fd, off_t offset) {
    struct camera *c = camera_of(fd);
    uint32_t index = (uint32_t)(offset / sysconf(_SC_PAGESIZE));
    if (index < c->buffers) return c->buffer[index].start;
    errno = EINVAL;
    return MAP_FAILED;
}

/* cv2 unmaps what it was given; a mapping of its own for each call keeps that apart from ours. */
static void *mapped(int fd, size_t length, off_t offset) {
    void *start = map(fd, offset);
    if (start == MAP_FAILED) return start;
    return mremap(start, 0, length, MREMAP_MAYMOVE); /* of a shared mapping: a second one of the same pages */
}

void *mmap(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    if (camera_of(fd) != NULL) return mapped(fd, length, offset);
    return REAL("mmap", mmap_call)(at, length, protection, flags, fd, offset);
}

void *mmap64(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    return mmap(at, length, protection, flags, fd, offset);
}

static int queue(struct camera *c, struct v4l2_buffer *b) {
    if (b->index >= c->buffers || c->queued >= BUFFERS) return refuse(EINVAL);
    int64_t next = (int64_t)floor(now_s(CLOCK_MONOTONIC) * c->header->fps - c->header->phase) + 1;
    if (next <= c->last) next = c->last + 1;
    c->buffer[b->index].frame = c->last = next;
    c->queue[(c->first + c->queued++) % BUFFERS] = b->index;
    describe(c, b);
    return 0;
}

static int is_ready(const struct camera *c) {
    if (!c->is_streaming || c->queued == 0 || c->header->silent) return 0;
    return now_s(CLOCK_MONOTONIC) >= due_s(c->header, c->buffer[c->queue[c->first]].frame);
}

static int dequeue(struct camera *c, struct v4l2_buffer *b) {
    if (!is_ready(c)) return refuse(EAGAIN);
    struct header *h = c->header;
    b->index = c->queue[c->first];
    c->first = (c->first + 1) % BUFFERS;
    c->queued--;
    describe(c, b);
    int64_t frame = c->buffer[b->index].frame;
    const struct place *place = place_of(h, frame);
    size_t size = place->size;
    if (h->torn_every && frame % h->torn_every == 0) size /= 2;
    memcpy(c->buffer[b->index].start, (const char *)h + place->offset, size);
    double t = due_s(h, frame);
    if (h->stamps == ZERO) t = 0.0;
    if (h->stamps == WALL_CLOCK) t += now_s(CLOCK_REALTIME) - now_s(CLOCK_MONOTONIC);
    b->bytesused = (uint32_t)size;
    b->sequence = (uint32_t)frame;
    b->timestamp.tv_sec = (time_t)t;
    b->timestamp.tv_usec = (suseconds_t)((t - floor(t)) * 1e6);
    h->served++;
    return 0;
}

/* --- what a camera is asked */

static int capability(struct v4l2_capability *a) {
    memset(a, 0, sizeof *a);
    strcpy((char *)a->driver, "shim");
    strcpy((char *)a->card, "Shim camera");
    a->capabilities = a->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
    return 0;
}

static int format(const struct header *h, struct v4l2_format *f) {
    if (f->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return refuse(EINVAL);
    memset(&f->fmt, 0, sizeof f->fmt);
    f->fmt.pix.width = h->width;
    f->fmt.pix.height = h->height;
    f->fmt.pix.pixelformat = h->fourcc;
    f->fmt.pix.field = V4L2_FIELD_NONE;
    f->fmt.pix.bytesperline = 2 * h->width;
    f->fmt.pix.sizeimage = (uint32_t)largest(h);
    return 0;
}

static int rate(const struct header *h, struct v4l2_streamparm *p) {
    if (p->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return refuse(EINVAL);
    p->parm.capture.capability = V4L2_CAP_TIMEPERFRAME;
    p->parm.capture.timeperframe.numerator = 1000;
    p->parm.capture.timeperframe.denominator = (uint32_t)(1000 * h->told_fps);
    return 0;
}

static struct control *control_of(struct header *h, uint32_t id) {
    for (uint32_t i = 0; i < h->controls; i++)
        if (h->control[i].id == id) return &h->control[i];
    return NULL;
}

static int query_control(struct header *h, struct v4l2_queryctrl *q) {
    const struct control *found = control_of(h, q->id);
    if (found == NULL) return refuse(EINVAL);
    q->type = V4L2_CTRL_TYPE_INTEGER;
    q->minimum = found->least;
    q->maximum = found->most;
    q->step = 1;
    q->default_value = found->least;
    q->flags = 0;
    return 0;
}

static int set_control(struct header *h, const struct v4l2_control *asked) {
    struct control *found = control_of(h, asked->id);
    if (found == NULL) return refuse(EINVAL);
    if (found->deaf) return refuse(EIO);
    int32_t value = asked->value;
    found->value = value < found->least ? found->least : value > found->most ? found->most : value;
    return 0;
}

static int get_control(struct header *h, struct v4l2_control *asked) {
    const struct control *found = control_of(h, asked->id);
    if (found == NULL) return refuse(EINVAL);
    asked->value = found->value;
    return 0;
}

static int query_buffer(const struct camera *c, struct v4l2_buffer *b) {
    if (b->index >= c->buffers) return refuse(EINVAL);
    describe(c, b);
    return 0;
}

static int answer(struct camera *c, unsigned long code, void *a) {
    struct header *h = c->header;
    if (h->unplugged) return refuse(ENODEV);
    switch (code) {
    case VIDIOC_QUERYCAP: return capability(a);
    case VIDIOC_ENUMINPUT: return ((struct v4l2_input *)a)->index == 0 ? 0 : refuse(EINVAL);
    case VIDIOC_G_INPUT: *(int *)a = 0; return 0;
    case VIDIOC_S_INPUT: return *(int *)a == 0 ? 0 : refuse(EINVAL);
    case VIDIOC_G_FMT: case VIDIOC_S_FMT: case VIDIOC_TRY_FMT: return format(h, a);
    case VIDIOC_G_PARM: case VIDIOC_S_PARM: return rate(h, a);
    case VIDIOC_QUERYCTRL: return query_control(h, a);
    case VIDIOC_G_CTRL: return get_control(h, a);
    case VIDIOC_S_CTRL: return set_control(h, a);
    case VIDIOC_REQBUFS: return request(c, a);
    case VIDIOC_QUERYBUF: return query_buffer(c, a);
    case VIDIOC_QBUF: return queue(c, a);
    case VIDIOC_DQBUF: return dequeue(c, a);
    case VIDIOC_STREAMON: c->is_streaming = 1; return 0;
    case VIDIOC_STREAMOFF: c->is_streaming = 0; c->queued = c->first = 0; return 0;
    }
    return refuse(ENOTTY);
}

int ioctl(int fd, unsigned long code, ...) {
    va_list rest;
    va_start(rest, code);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    pthread_mutex_lock(&lock);
    struct camera *c = camera_of(fd);
    int result = c == NULL ? 0 : answer(c, code & 0xffffffffUL, argument);
    pthread_mutex_unlock(&lock);
    return c == NULL ? REAL("ioctl", ioctl_call)(fd, code, argument) : result;
}

/* --- waiting */

static struct camera *asked_for(int count, const fd_set *read) {
    for (int fd = 0; read != NULL && fd < count; fd++)
        if (FD_ISSET(fd, read) && camera_of(fd) != NULL) return camera_of(fd);
    return NULL;
}

int select(int count, fd_set *read, fd_set *write, fd_set *except, struct timeval *timeout) {
    struct camera *c = asked_for(count, read);
    if (c == NULL) return REAL("select", select_call)(count, read, write, except, timeout);
    int fd = c->fd;
    double until = now_s(CLOCK_MONOTONIC) + (timeout == NULL ? 1e9 : timeout->tv_sec + 1e-6 * timeout->tv_usec);
    for (;;) {
        pthread_mutex_lock(&lock);
        int is_done = c->fd != fd || c->header->unplugged || is_ready(c);
        pthread_mutex_unlock(&lock);
        if (is_done) break;
        if (now_s(CLOCK_MONOTONIC) >= until) {
            FD_ZERO(read);
            return 0;
        }
        struct timespec pause = {0, (long)(1e9 * PATIENCE_S / 5)};
        nanosleep(&pause, NULL);
    }
    FD_ZERO(read);
    FD_SET(fd, read);
    return 1;
}
