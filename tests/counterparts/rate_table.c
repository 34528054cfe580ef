/* A three-axis rate table with a triad of gyros that is not ours: libmodbus carries, everything else is written here.
 *
 *     rate_table tcp TRUTH                  three drives, unit ids 1 to 3 for x, y, z, and the gyros
 *     rate_table rtu TRUTH PORT BAUD UNIT   one drive, of axis x, on a serial port
 *
 * Prints the TCP port (0 for rtu) and the terminal of the gyros, then runs until it is ended. Drives have the register
 * map of Kinco FD3 (manual p. 122-123) and walk the state machine of CiA 402. Motion is worked out in steps of 0.5 ms
 * of the host's clock, and CYCLE_S of the environment is how often a drive samples its controlword: a rate that changes by no more than the acceleration, and brakes in time for where it ends.
 *
 * The gyros lie along x, y, z of a body within gimbals z, y, x, outermost first, at 45 deg north, x to the north. They
 * send lines "gx,gy,gz" in deg/s, 100 a second: (1 - k) w - b and white noise. TRUTH is a file of nine doubles, kept
 * up to date: angles in rad, rates in rad/s of x, y, z; then how many requests came, the state of x, and a zero. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { FIRST = 0x1F00, LAST = 0x6F01, AXES = 3, CLIENTS = 32 };
enum { ERRORS = 0x1F00, CONTROL = 0x3100, STATUS = 0x3200, MODE = 0x3500, POSITION = 0x3700, RATE = 0x3B00 };
enum { TARGET = 0x4000, PROFILE = 0x4A00, ACCELERATE = 0x4B00, BRAKE = 0x4C00, SEEK = 0x5010, TARGET_RATE = 0x6F00 };
enum { DISABLED = 0x40, READY = 0x21, SWITCHED_ON = 0x23, OPERATION = 0x27, QUICK_STOP = 0x07 };

static const double COUNTS = 65536, TURN = 2 * M_PI, STEP_S = 0.0005, FASTEST_RPS = 100 * M_PI / 180;
static const double K[] = {0.004, -0.003, 0.002}, B_DPS[] = {0.08, -0.05, 0.03}, NOISE_DPS = 0.05;
static double *truth, began;
static long steps, cycle; /* steps between two samples of the controlword; 0: it acts at once */
static int gyros = -1; /* the near end of their terminal; -1: none */

struct drive {
    modbus_mapping_t *map;
    int state, last_control, homing, homed, acknowledged;
    double angle, rate, zero; /* rad, rad/s; where the position register reads nought */
    double goal, fastest, wanted;
    int positions, written, waiting; /* a controlword that waits to be sampled */
} drives[AXES];

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static uint16_t *at(struct drive *d, int address) { return d->map->tab_registers + (address - FIRST); }
static int32_t get32(struct drive *d, int address) { return (int32_t)(at(d, address)[0] | (uint32_t)at(d, address)[1] << 16); }
static void put32(struct drive *d, int address, int32_t value)
{
    at(d, address)[0] = value & 0xFFFF;
    at(d, address)[1] = (uint32_t)value >> 16;
}
static double speed(struct drive *d, int address) { return get32(d, address) / COUNTS / 60 / 512 * 1875 * TURN; } /* DEC */
static double ramp(struct drive *d, int address)
{
    double wanted = (uint32_t)get32(d, address) / COUNTS * 4e6 / 65536 * TURN;
    return wanted > 0.01 ? wanted : 1.0;
}

/* Half a millisecond of an axis. */
static void step(struct drive *d)
{
    double most = ramp(d, ACCELERATE), wanted = d->wanted, left = d->goal - d->angle;
    if (d->positions) {
        double brake = ramp(d, BRAKE), stoppable = sqrt(2 * 0.97 * brake * fabs(left));
        wanted = copysign(fmin(d->fastest, stoppable), left);
        if (fabs(left) < 2e-5 && fabs(d->rate) < 4 * brake * STEP_S) {
            d->angle = d->goal;
            d->rate = 0;
            if (d->homing)
                d->zero = d->angle, d->homing = 0, d->homed = 1;
            return;
        }
        most = brake > most ? brake : most;
    } else if (fabs(wanted) < fabs(d->rate))
        most = ramp(d, BRAKE);
    double change = wanted - d->rate, limit = most * STEP_S, before = d->rate;
    d->rate += change > limit ? limit : change < -limit ? -limit : change;
    d->angle += (before + d->rate) / 2 * STEP_S;
}

static void hold(struct drive *d) { d->positions = 0, d->homing = 0, d->wanted = 0; }

static void controlled(struct drive *d, int word)
{
    int rising = word & ~d->last_control;
    d->last_control = word;
    if (!(word & 2))
        hold(d), d->state = DISABLED;
    else if (!(word & 4)) {
        if (d->state == OPERATION)
            hold(d), d->state = QUICK_STOP;
        else if (d->state != QUICK_STOP)
            d->state = DISABLED;
    } else if ((word & 15) == 15 && d->state != DISABLED) {
        if (d->state != OPERATION)
            hold(d), d->state = OPERATION;
    } else if (d->state == QUICK_STOP)
        ;
    else if ((word & 15) == 7)
        hold(d), d->state = d->state == DISABLED ? DISABLED : SWITCHED_ON;
    else if ((word & 15) == 6)
        hold(d), d->state = READY;
    if (d->state != OPERATION)
        return;
    int mode = *at(d, MODE) & 0xFF;
    d->acknowledged = d->acknowledged && (word & 16);
    if (mode == 3)
        d->positions = 0, d->wanted = speed(d, TARGET_RATE);
    else if (mode == 6 && rising & 16) {
        d->homing = 1, d->homed = 0, d->positions = 1, d->fastest = speed(d, SEEK);
        d->goal = ceil(d->angle / TURN) * TURN; /* the index pulse, in positive direction */
    } else if (mode == 1 && rising & 16) {
        d->acknowledged = 1, d->positions = 1, d->fastest = speed(d, PROFILE);
        d->goal = get32(d, TARGET) / COUNTS * TURN + d->zero;
    }
}

static void tell(struct drive *d)
{
    int mode = *at(d, MODE) & 0xFF, word = d->state | 0x10, stands = d->rate == 0;
    if (d->positions ? stands && d->angle == d->goal : d->rate == d->wanted)
        word |= 0x400;
    if (mode == 6 ? d->homed : mode == 1 ? d->acknowledged : stands)
        word |= 0x1000;
    *at(d, STATUS) = word;
    *at(d, ERRORS) = 0;
    put32(d, POSITION, (int32_t)lround((d->angle - d->zero) / TURN * COUNTS));
    put32(d, RATE, (int32_t)lround(d->rate / TURN * 60 * 512 / 1875 * COUNTS));
}

static int refused(int address, int32_t value)
{
    if (address == MODE)
        return value != 1 && value != 3 && value != 6;
    if (address == TARGET_RATE || address == PROFILE)
        return fabs(value / COUNTS / 60 / 512 * 1875 * TURN) > 1.001 * FASTEST_RPS;
    return address == STATUS || address == POSITION || address == RATE;
}

static double gauss(void)
{
    double u = drand48(), v = drand48();
    return sqrt(-2 * log(u > 0 ? u : 1e-12)) * cos(TURN * v);
}

static void measure(void)
{
    double x = drives[0].angle, y = drives[1].angle, z = drives[2].angle, earth = TURN / 86164.0905, line[3];
    double north = earth * M_SQRT1_2, up = earth * M_SQRT1_2;
    double a = cos(z) * north, b = -sin(z) * north, c = up + drives[2].rate;         /* after z has turned */
    double e = cos(y) * a - sin(y) * c, f = b + drives[1].rate, g = sin(y) * a + cos(y) * c; /* and y */
    double w[] = {e + drives[0].rate, cos(x) * f + sin(x) * g, -sin(x) * f + cos(x) * g};
    char text[80];
    for (int i = 0; i < 3; i++)
        line[i] = (1 - K[i]) * w[i] * 180 / M_PI - B_DPS[i] + NOISE_DPS * gauss();
    int size = snprintf(text, sizeof text, "%.4f,%.4f,%.4f\n", line[0], line[1], line[2]);
    if (write(gyros, text, size) < 0 && errno != EAGAIN)
        perror("gyros");
}

/* Bring axes and gyros up to now. */
static void advance(void)
{
    for (; steps * STEP_S < now_s() - began; steps++) {
        for (int i = 0; i < AXES; i++) {
            if (cycle && steps % cycle == 0 && drives[i].waiting)
                drives[i].waiting = 0, controlled(&drives[i], drives[i].written);
            step(&drives[i]);
        }
        if (gyros >= 0 && steps % 20 == 0)
            measure();
    }
    for (int i = 0; i < AXES; i++)
        truth[i] = drives[i].angle, truth[3 + i] = drives[i].rate;
    truth[7] = drives[0].state;
}

static void serve(modbus_t *bus, int unit_of_one)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int size = modbus_receive(bus, query), head = modbus_get_header_length(bus);
    if (size == 0)
        return; /* for another unit */
    if (size < 0) {
        if (!unit_of_one)
            close(modbus_get_socket(bus)), modbus_set_socket(bus, -1);
        return;
    }
    int unit = unit_of_one ? 1 : query[head - 1], function = query[head], address = query[head + 1] << 8 | query[head + 2];
    truth[6] += 1;
    advance();
    if (unit < 1 || unit > AXES) {
        modbus_reply_exception(bus, query, MODBUS_EXCEPTION_GATEWAY_TARGET);
        return;
    }
    struct drive *d = &drives[unit - 1];
    tell(d);
    int written = function == 6 || function == 16, data = head + (function == 6 ? 3 : 6);
    int32_t value = written ? query[data] << 8 | query[data + 1] : 0;
    if (function == 16 && query[head + 5] == 4)
        value |= (query[data + 2] << 8 | query[data + 3]) << 16;
    if (function != 3 && !written)
        modbus_reply_exception(bus, query, MODBUS_EXCEPTION_ILLEGAL_FUNCTION);
    else if (written && refused(address, value))
        modbus_reply_exception(bus, query, MODBUS_EXCEPTION_ILLEGAL_DATA_VALUE);
    else if (modbus_reply(bus, query, size, d->map) > 0 && written) {
        if (address == CONTROL && cycle)
            d->written = value, d->waiting = 1;
        else if (address == CONTROL)
            controlled(d, value);
        else if (address == TARGET_RATE && d->state == OPERATION && (*at(d, MODE) & 0xFF) == 3)
            d->positions = 0, d->wanted = speed(d, TARGET_RATE);
    }
}

int main(int argc, char **argv)
{
    int tcp = argc == 3, unit = tcp ? 0 : atoi(argv[5]), listener = -1, port = 0, clients[CLIENTS], count = 0;
    int kept = open(argv[2], O_RDWR | O_CREAT, 0600);
    struct termios raw;
    cycle = getenv("CYCLE_S") ? lround(atof(getenv("CYCLE_S")) / STEP_S) : 0;
    gyros = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (kept < 0 || gyros < 0 || ftruncate(kept, 9 * sizeof(double)) || grantpt(gyros) || unlockpt(gyros))
        return 1;
    truth = mmap(NULL, 9 * sizeof(double), PROT_READ | PROT_WRITE, MAP_SHARED, kept, 0);
    char *terminal = ptsname(gyros);
    int near = open(terminal, O_RDWR | O_NOCTTY); /* so that readers may come and go */
    tcgetattr(near, &raw), cfmakeraw(&raw), tcsetattr(near, TCSANOW, &raw);
    for (int i = 0; i < AXES; i++) {
        drives[i].map = modbus_mapping_new_start_address(0, 0, 0, 0, FIRST, LAST - FIRST + 1, 0, 0);
        drives[i].state = DISABLED, drives[i].angle = drives[i].goal = (-3 + 0.5 * i) * M_PI / 180;
        drives[i].zero = -1.0, *at(&drives[i], MODE) = 3;
    }
    modbus_t *bus = tcp ? modbus_new_tcp("127.0.0.1", 0) : modbus_new_rtu(argv[3], atoi(argv[4]), 'N', 8, 1);
    modbus_set_response_timeout(bus, 1, 0);
    if (tcp) {
        struct sockaddr_in bound;
        socklen_t length = sizeof bound;
        listener = modbus_tcp_listen(bus, 8);
        getsockname(listener, (struct sockaddr *)&bound, &length), port = ntohs(bound.sin_port);
    } else if (modbus_set_slave(bus, unit) || modbus_connect(bus))
        return 1;
    else
        clients[count++] = modbus_get_socket(bus);
    printf("%d\n%s\n", port, terminal), fflush(stdout);
    began = now_s();
    for (;;) {
        advance();
        fd_set ready;
        int highest = listener;
        FD_ZERO(&ready);
        if (listener >= 0)
            FD_SET(listener, &ready);
        for (int i = 0; i < count; i++) {
            FD_SET(clients[i], &ready);
            highest = clients[i] > highest ? clients[i] : highest;
        }
        struct timeval wait = {0, 1000};
        if (select(highest + 1, &ready, NULL, NULL, &wait) <= 0)
            continue;
        if (listener >= 0 && FD_ISSET(listener, &ready) && count < CLIENTS)
            clients[count++] = accept(listener, NULL, NULL);
        for (int i = 0; i < count; i++)
            if (FD_ISSET(clients[i], &ready)) {
                modbus_set_socket(bus, clients[i]);
                serve(bus, unit);
                if (modbus_get_socket(bus) < 0)
                    clients[i--] = clients[--count];
            }
    }
}
