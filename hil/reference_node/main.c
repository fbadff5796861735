/* The reference node as a process: SocketCAN on one side, on the other a Unix socket to the plant that stands in for its
 * thrusters and sensors. Use: modcube_node INTERFACE NUMBER RATE_HZ SOCKET. Ends when the plant does, or by a signal. */
#define _GNU_SOURCE
#include "node.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define WATCH_MS (10)
#define CANNOT_RUN (2)
#define OUTPUTS_ALONE (-1.0)

/* To the plant. */
struct request {
    double due;  /* slow messages sent in this tick, one bit each; OUTPUTS_ALONE: no answer expected */
    struct node_outputs outputs;
};

/* From the plant. */
struct answer {
    double tick;
    struct node_readings readings;
};

struct board {
    int can;
    int plant;
    struct node_outputs outputs;
    bool is_plant_gone;
};

static int refuse(const char *what)
{
    fprintf(stderr, "modcube_node: %s: %s\n", what, strerror(errno));
    return CANNOT_RUN;
}

static void tell(struct board *board, double due)
{
    struct request request = {.due = due, .outputs = board->outputs};
    if (send(board->plant, &request, sizeof request, MSG_NOSIGNAL) < 0 && errno != EAGAIN) {
        board->is_plant_gone = true;
    }
}

static void apply(void *context, const struct node_outputs *outputs)
{
    struct board *board = context;
    board->outputs = *outputs;
    tell(board, OUTPUTS_ALONE);
}

/* An answer may take at most half a tick. A later one is discarded while the next answer is awaited. */
static bool sample(void *context, uint32_t due, struct node_readings *readings)
{
    struct board *board = context;
    struct answer answer;
    tell(board, (double)due);
    do {
        ssize_t size = recv(board->plant, &answer, sizeof answer, 0);
        if (size == 0) {
            board->is_plant_gone = true;
        }
        if (size != (ssize_t)sizeof answer) {
            return false;
        }
    } while (answer.tick != board->outputs.tick);
    *readings = answer.readings;
    return true;
}

/* A bus that is down or full loses the frame; the firmware counts nodes that do not answer. */
static void send_frame(void *context, uint16_t id, const uint8_t *data, uint8_t length)
{
    struct board *board = context;
    struct can_frame frame = {.can_id = id, .can_dlc = length};
    memcpy(frame.data, data, length);
    if (write(board->can, &frame, sizeof frame) < 0 && errno == EBADF) {
        board->is_plant_gone = true;
    }
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static int open_can(const char *interface)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    int can = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
    if (can < 0 || address.can_ifindex == 0 || bind(can, (struct sockaddr *)&address, sizeof address) < 0) {
        return -1;
    }
    return can;
}

static int open_plant(const char *path, long rate_hz)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    struct timeval half_tick = {.tv_usec = 500000 / rate_hz};
    if (strlen(path) >= sizeof address.sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    strcpy(address.sun_path, path);
    int plant = socket(AF_UNIX, SOCK_SEQPACKET, 0);
    setsockopt(plant, SOL_SOCKET, SO_RCVTIMEO, &half_tick, sizeof half_tick);
    return plant < 0 || connect(plant, (struct sockaddr *)&address, sizeof address) < 0 ? -1 : plant;
}

static void serve(struct node *node, struct board *board)
{
    struct pollfd events[] = {{.fd = board->can, .events = POLLIN}, {.fd = board->plant}};
    while (!board->is_plant_gone) {
        struct can_frame frame;
        poll(events, 2, WATCH_MS);
        board->is_plant_gone |= (events[1].revents & (POLLERR | POLLHUP)) != 0;  /* it may end while nothing is sent to it */
        while (read(board->can, &frame, sizeof frame) == (ssize_t)sizeof frame) {
            if ((frame.can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG)) == 0) {
                node_take(node, (uint16_t)frame.can_id, frame.data, frame.can_dlc, now_ns());
            }
        }
        node_watch(node, now_ns());
        if ((events[0].revents & (POLLERR | POLLHUP)) != 0) {
            usleep(1000 * WATCH_MS);  /* the interface is down */
        }
    }
}

int main(int count, char **words)
{
    if (count != 5) {
        fprintf(stderr, "modcube_node: use: modcube_node INTERFACE NUMBER RATE_HZ SOCKET\n");
        return CANNOT_RUN;
    }
    long number = strtol(words[2], NULL, 10), rate_hz = strtol(words[3], NULL, 10);
    if (number < 1 || number > 29 || rate_hz < 50 || rate_hz > 400) {
        fprintf(stderr, "modcube_node: NUMBER must be 1 to 29 and RATE_HZ 50 to 400\n");
        return CANNOT_RUN;
    }
    struct board board = {.can = open_can(words[1])};
    if (board.can < 0) {
        return refuse(words[1]);
    }
    board.plant = open_plant(words[4], rate_hz);
    if (board.plant < 0) {
        return refuse(words[4]);
    }
    struct node node;
    struct node_hardware hardware = {.context = &board, .apply = apply, .sample = sample, .send = send_frame};
    node_start(&node, (uint8_t)number, (uint16_t)rate_hz, &hardware);
    serve(&node, &board);
    return 0;
}
