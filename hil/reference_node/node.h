/* Reference node: what the microcontroller of one module does on the bus, without its hardware. SYNC in, status and
 * sensors out, zero thrust after 100 ms of silence, pushing magnets off after 2 s. No allocation, no clock, no global
 * state: the caller provides the time and three hardware functions. The rules are in can_dbc/README.md. */
#ifndef MODCUBE_NODE_H
#define MODCUBE_NODE_H

#include "modcube_wire.h"

#define NODE_THRUSTERS (8)
#define NODE_FACES (6)
#define NODE_SLOW (9)
#if NODE_SLOW != MODCUBE_SLOW_COUNT
#error "the DBC has other slow messages: they belong into node_readings here, send_slow in node.c and Readings in board.py"
#endif
#define NODE_VERSION (1u)
#define NODE_TIMEOUT_NS (100000000)  /* a half of THRUSTER_CMD that is older commands zero */
#define NODE_RELEASE_NS (200000000)  /* silence of ESTOP frames after which the e-stop may be released */
#define NODE_PUSH_NS (2000000000)  /* a pushing magnet is switched off when DOCK_CMD is older; a pulling one stays on */

/* Commands to the hardware. */
struct node_outputs {
    double tick;  /* the last SYNC */
    double thruster[NODE_THRUSTERS];  /* share of full command, -1 to 1 */
    double relay[NODE_FACES];  /* 0 off, 1 forward, 2 reverse */
};

/* Sensor readings, in the units of the DBC. */
struct node_readings {
    double gyro[4];  /* x, y, z, status */
    double accel[4];
    double depth[3];  /* pressure, water temperature, status */
    double dock[2][6];  /* faces A B C and D E F: three currents, three relay echoes */
    double esc[4][6];  /* two ESCs: speed, current, status each */
    double power[3];  /* voltage, current, status */
    double environment[3];  /* cabin temperature, cabin pressure, leak */
};

struct node_hardware {
    void *context;
    void (*apply)(void *context, const struct node_outputs *outputs);
    /* Fills in the readings. Bit i of `due` is set if slow message i (DEPTH is 0) is sent now. False: no sensors. */
    bool (*sample)(void *context, uint32_t due, struct node_readings *readings);
    void (*send)(void *context, uint16_t id, const uint8_t *data, uint8_t length);
};

struct node {
    struct node_hardware hardware;
    struct modcube_receiver receiver;
    uint16_t rate_hz;
    struct node_outputs applied;
    double command[NODE_THRUSTERS];
    bool armed[2];
    bool accepted[2];
    int64_t accepted_ns[2];
    bool stopped;
    int64_t stopped_ns;
    int64_t docked_ns;
    uint8_t errors;
    uint8_t counters[NODE_SLOW];
};

/* A node at rest: nothing commanded, nothing accepted. */
void node_start(struct node *node, uint8_t number, uint16_t rate_hz, const struct node_hardware *hardware);

/* Handles one frame from the bus at `now_ns`, whatever its content. */
void node_take(struct node *node, uint16_t id, const uint8_t *data, size_t length, int64_t now_ns);

/* Handles timeouts, which need no frame; call it at least every 10 ms. */
void node_watch(struct node *node, int64_t now_ns);

/* Size of a struct node in bytes, for callers without its definition. */
size_t node_size(void);

#endif
