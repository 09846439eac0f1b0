/* The reference device on a pseudo terminal, with pistons that follow the command.
 *
 *     posix_bench CONFIG virtual|realtime [PARENT]
 *
 * prints `serial:///dev/pts/N` and ends on SIGTERM, SIGINT or with process PARENT. CONFIG has a
 * line per fact, channels and joints in order:
 *
 *     name NAME
 *     rate HZ
 *     checksum NUMBER
 *     joint COMMAND_RANGE COMMAND_BITS PISTON_CHANNEL LOW HIGH BITS
 *     channel spool|piston JOINT LOW HIGH BITS     (JOINT from 0)
 *     channel constant VALUE LOW HIGH BITS
 *     channel count 0 0 0 0                        (the number of the sample)
 */
#define _XOPEN_SOURCE 600

#include "serial_device.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define SPEED_PER_VOLT 0.02 /* [m/(s V)] */
#define SPOOL_PER_VOLT 0.1

enum kind { SPOOL, PISTON, CONSTANT, COUNT };

typedef struct {
    enum kind kind;
    double value, low, high; /* value: joint, or what a constant shows */
    unsigned bits;
} channel;

typedef struct {
    sd_config config;
    channel channels[SD_MAX_CHANNELS];
    double piston[SD_MAX_JOINTS], volts[SD_MAX_JOINTS];
    uint32_t samples;
} bench;

static volatile sig_atomic_t told_to_end;

static void end(int number)
{
    (void)number;
    told_to_end = 1;
}

static void measure(void *context, uint16_t *codes)
{
    bench *b = context;
    for (unsigned c = 0; c < b->config.channels; c++) {
        const channel *ch = &b->channels[c];
        double top = (double)((1UL << ch->bits) - 1), value = ch->value, code;
        if (ch->kind == COUNT) {
            codes[c] = (uint16_t)b->samples;
            continue;
        }
        if (ch->kind == SPOOL)
            value = SPOOL_PER_VOLT * b->volts[(unsigned)ch->value];
        if (ch->kind == PISTON)
            value = b->piston[(unsigned)ch->value];
        code = (value - ch->low) * top / (ch->high - ch->low) + 0.5;
        codes[c] = (uint16_t)(code < 0 ? 0 : code > top ? top : code);
    }
    b->samples++;
    /* What was put out in the sample before moved the pistons up to here; see `output`. */
}

static void output(void *context, const int16_t *codes)
{
    bench *b = context;
    for (unsigned j = 0; j < b->config.joints; j++) {
        const sd_joint *joint = &b->config.joint[j];
        double top = (double)((1UL << (joint->command_bits - 1)) - 1);
        b->volts[j] = codes[j] * (double)joint->command_range / top;
    }
}

static void move(bench *b)
{
    for (unsigned j = 0; j < b->config.joints; j++)
        b->piston[j] += SPEED_PER_VOLT * b->volts[j] / (double)b->config.sample_rate;
}

static int read_config(bench *b, FILE *file)
{
    static char name[64];
    char line[256], kind[16];
    b->config.name = name;
    while (fgets(line, sizeof line, file)) {
        sd_joint *joint = &b->config.joint[b->config.joints % SD_MAX_JOINTS];
        channel *ch = &b->channels[b->config.channels % SD_MAX_CHANNELS];
        unsigned long checksum;
        if (sscanf(line, "name %63s", name) == 1
            || sscanf(line, "rate %f", &b->config.sample_rate) == 1)
            continue;
        if (sscanf(line, "checksum %lu", &checksum) == 1)
            b->config.converter_checksum = (uint32_t)checksum;
        else if (sscanf(line, "joint %f %u %u %f %f %u", &joint->command_range,
                        &joint->command_bits, &joint->piston_channel, &joint->piston_low,
                        &joint->piston_high, &joint->piston_bits) == 6)
            b->config.joints++;
        else if (sscanf(line, "channel %15s %lf %lf %lf %u", kind, &ch->value, &ch->low,
                        &ch->high, &ch->bits) == 5) {
            ch->kind = !strcmp(kind, "spool") ? SPOOL : !strcmp(kind, "piston") ? PISTON
                       : !strcmp(kind, "count") ? COUNT : CONSTANT;
            b->config.channels++;
        } else
            return 0;
    }
    return b->config.joints >= 1 && b->config.joints <= SD_MAX_JOINTS
           && b->config.channels >= 1 && b->config.channels + b->config.joints <= 120;
}

static int open_pty(char *name, size_t size)
{
    struct termios raw;
    int fd = posix_openpt(O_RDWR | O_NOCTTY), slave;
    if (fd < 0 || grantpt(fd) || unlockpt(fd))
        return -1;
    snprintf(name, size, "%s", ptsname(fd));
    slave = open(name, O_RDWR | O_NOCTTY);
    if (slave < 0 || tcgetattr(slave, &raw))
        return -1;
    raw.c_iflag = raw.c_oflag = raw.c_lflag = 0;
    raw.c_cflag = (raw.c_cflag & ~(tcflag_t)(CSIZE | PARENB)) | CS8;
    tcsetattr(slave, TCSANOW, &raw);
    close(slave);
    return fcntl(fd, F_SETFL, O_NONBLOCK) ? -1 : fd;
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void step(sd_device *d, bench *b)
{
    sd_tick(d);
    move(b);
}

/* Write what waits; returns whether some of it still does. */
static int send(sd_device *d, int fd)
{
    static uint8_t unsent[4096];
    static size_t begin, size;
    for (;;) {
        ssize_t written;
        if (begin == size) {
            begin = 0;
            size = sd_transmit(d, unsent, sizeof unsent);
            if (!size)
                return 0;
        }
        written = write(fd, unsent + begin, size - begin);
        if (written <= 0)
            return 1;
        begin += (size_t)written;
    }
}

static void serve(sd_device *d, bench *b, int fd, pid_t parent)
{
    const double origin = seconds();
    double ticks = 0.0;
    int connected = 0, blocked = 0;
    while (!told_to_end && (!parent || getppid() == parent)) {
        struct pollfd waiting = {fd, (short)(POLLIN | (blocked ? POLLOUT : 0)), 0};
        const int realtime = !b->config.virtual_time;
        uint8_t data[4096];
        ssize_t size = 0;
        uint32_t now_ms;
        if (poll(&waiting, 1, realtime ? 1 : 20) < 0 && errno != EINTR)
            return;
        if (waiting.revents & POLLIN)
            size = read(fd, data, sizeof data);
        now_ms = (uint32_t)(uint64_t)(seconds() * 1e3);
        if (size > 0) {
            connected = 1;
            sd_receive(d, data, (size_t)size, now_ms);
        } else if (waiting.revents & POLLHUP) {
            if (connected)
                sd_host_lost(d);
            connected = 0;
            poll(NULL, 0, 1);
        }
        while (sd_wants_tick(d))
            step(d, b);
        if (realtime) {
            double due = (seconds() - origin) * (double)b->config.sample_rate;
            for (; ticks + 1.0 <= due; ticks += 1.0)
                step(d, b);
        }
        sd_poll(d, now_ms);
        blocked = connected ? send(d, fd) : 0;
    }
}

int main(int argc, char **argv)
{
    static sd_device device;
    static bench b;
    sd_board board = {measure, output, &b};
    struct sigaction on_end;
    char name[128];
    FILE *file;
    int fd;
    if (argc < 3 || !(file = fopen(argv[1], "r"))) {
        fprintf(stderr, "usage: posix_bench CONFIG virtual|realtime [PARENT]\n");
        return 2;
    }
    if (!read_config(&b, file)) {
        fprintf(stderr, "posix_bench: %s is no description of a bench\n", argv[1]);
        return 2;
    }
    fclose(file);
    b.config.virtual_time = !strcmp(argv[2], "virtual");
    memset(&on_end, 0, sizeof on_end);
    on_end.sa_handler = end;
    sigaction(SIGTERM, &on_end, NULL);
    sigaction(SIGINT, &on_end, NULL);
    fd = open_pty(name, sizeof name);
    if (fd < 0) {
        perror("posix_bench: no pseudo terminal");
        return 4;
    }
    sd_init(&device, &b.config, &board);
    printf("serial://%s\n", name);
    fflush(stdout);
    serve(&device, &b, fd, argc > 3 ? (pid_t)atol(argv[3]) : 0);
    close(fd);
    return 0;
}
