/* The rules of the reference node, which node.h describes. */
#include "node.h"

#include <string.h>

#define MESSAGE_BYTES (8u)
#define FIRST_SLOW (MODCUBE_DEPTH)

enum { STATE_DISARMED = 1, STATE_ARMED = 2, STATE_TIMEOUT = 3, STATE_ESTOP = 4 };
enum { ERROR_CRC = 1, ERROR_COUNTER = 2, ERROR_LENGTH = 4, ERROR_TIMEOUT = 8, ERROR_SENSOR = 16 };
enum { SENSOR_FAULT = 15 };
enum { RELAY_OFF = MODCUBE_DOCK_CMD_RELAY_A_OFF_CHOICE, RELAY_REVERSE = MODCUBE_DOCK_CMD_RELAY_A_REVERSE_CHOICE };

size_t node_size(void)
{
    return sizeof(struct node);
}

void node_start(struct node *node, uint8_t number, uint16_t rate_hz, const struct node_hardware *hardware)
{
    memset(node, 0, sizeof *node);
    node->hardware = *hardware;
    node->receiver.number = number;
    node->rate_hz = rate_hz;
}

static void apply(struct node *node, const double *thruster)
{
    memcpy(node->applied.thruster, thruster, sizeof node->applied.thruster);
    node->hardware.apply(node->hardware.context, &node->applied);
}

static bool is_live(const struct node *node, int half, int64_t now_ns)
{
    return node->accepted[half] && now_ns - node->accepted_ns[half] <= NODE_TIMEOUT_NS;
}

static void send(struct node *node, enum modcube_message_index message, uint8_t *data, uint8_t counter)
{
    uint16_t id = modcube_id(message, node->receiver.number);
    modcube_seal(message, id, data, counter);
    node->hardware.send(node->hardware.context, id, data, MODCUBE_MESSAGES[message].length);
}

/* A command for half of the thrusters: raw values, then the mode. */
static void take_command(struct node *node, int half, const int16_t *raw, uint8_t mode, int64_t now_ns)
{
    for (int i = 0; i < 4; i++) {
        node->command[4 * half + i] = modcube_thruster_cmd_a_thruster1_decode(raw[i]);
    }
    node->armed[half] = mode == MODCUBE_THRUSTER_CMD_A_MODE_ARMED_CHOICE;
    node->accepted[half] = true;
    node->accepted_ns[half] = now_ns;
    if (mode == MODCUBE_THRUSTER_CMD_A_MODE_DISARMED_CHOICE && now_ns - node->stopped_ns >= NODE_RELEASE_NS) {
        node->stopped = false;
    }
}

static void take_command_a(struct node *node, const uint8_t *data, int64_t now_ns)
{
    struct modcube_thruster_cmd_a_t c;
    modcube_thruster_cmd_a_unpack(&c, data, MESSAGE_BYTES);
    take_command(node, 0, (int16_t[]){c.thruster1, c.thruster2, c.thruster3, c.thruster4}, c.mode, now_ns);
}

static void take_command_b(struct node *node, const uint8_t *data, int64_t now_ns)
{
    struct modcube_thruster_cmd_b_t c;
    modcube_thruster_cmd_b_unpack(&c, data, MESSAGE_BYTES);
    take_command(node, 1, (int16_t[]){c.thruster5, c.thruster6, c.thruster7, c.thruster8}, c.mode, now_ns);
}

static void take_dock(struct node *node, const uint8_t *data, int64_t now_ns)
{
    struct modcube_dock_cmd_t c;
    modcube_dock_cmd_unpack(&c, data, MODCUBE_DOCK_CMD_LENGTH);
    const uint8_t relays[NODE_FACES] = {c.relay_a, c.relay_b, c.relay_c, c.relay_d, c.relay_e, c.relay_f};
    for (int i = 0; i < NODE_FACES; i++) {
        node->applied.relay[i] = node->stopped && relays[i] == RELAY_REVERSE ? RELAY_OFF : relays[i];
    }
    node->docked_ns = now_ns;
    node->hardware.apply(node->hardware.context, &node->applied);
}

/* Switches off pushing magnets. Pulling ones hold joints and stay on. Returns whether any was pushing. */
static bool end_push(struct node *node)
{
    bool pushed = false;
    for (int i = 0; i < NODE_FACES; i++) {
        if (node->applied.relay[i] == RELAY_REVERSE) {
            node->applied.relay[i] = RELAY_OFF;
            pushed = true;
        }
    }
    return pushed;
}

/* Sends three scaled axes and a status each: GYRO and ACCEL have the same layout but different factors. */
static void send_inertial(struct node *node, const struct node_readings *r, uint8_t counter)
{
    uint8_t data[MESSAGE_BYTES];
    struct modcube_gyro_t gyro = {
        .rate_x = modcube_gyro_rate_x_from(r->gyro[0]),
        .rate_y = modcube_gyro_rate_y_from(r->gyro[1]),
        .rate_z = modcube_gyro_rate_z_from(r->gyro[2]),
        .gyro_status = (uint8_t)r->gyro[3],
    };
    modcube_gyro_pack(data, &gyro, sizeof data);
    send(node, MODCUBE_GYRO, data, counter);
    struct modcube_accel_t accel = {
        .accel_x = modcube_accel_accel_x_from(r->accel[0]),
        .accel_y = modcube_accel_accel_y_from(r->accel[1]),
        .accel_z = modcube_accel_accel_z_from(r->accel[2]),
        .accel_status = (uint8_t)r->accel[3],
    };
    modcube_accel_pack(data, &accel, sizeof data);
    send(node, MODCUBE_ACCEL, data, counter);
}

static void pack_depth(uint8_t *data, const struct node_readings *r)
{
    struct modcube_depth_t depth = {
        .pressure = modcube_depth_pressure_from(r->depth[0]),
        .water_temperature = modcube_depth_water_temperature_from(r->depth[1]),
        .depth_status = (uint8_t)r->depth[2],
    };
    modcube_depth_pack(data, &depth, MESSAGE_BYTES);
}

static void pack_dock(uint8_t *data, const double *v)
{
    struct modcube_dock_current_abc_t dock = {
        .current_a = modcube_dock_current_abc_current_a_from(v[0]),
        .current_b = modcube_dock_current_abc_current_b_from(v[1]),
        .current_c = modcube_dock_current_abc_current_c_from(v[2]),
        .relay_echo_a = (uint8_t)v[3],
        .relay_echo_b = (uint8_t)v[4],
        .relay_echo_c = (uint8_t)v[5],
    };
    modcube_dock_current_abc_pack(data, &dock, MESSAGE_BYTES);
}

static void pack_esc(uint8_t *data, const double *v)
{
    struct modcube_esc_feedback_1_t esc = {
        .rpm1 = modcube_esc_feedback_1_rpm1_from(v[0]),
        .esc_current1 = modcube_esc_feedback_1_esc_current1_from(v[1]),
        .esc_status1 = (uint8_t)v[2],
        .rpm2 = modcube_esc_feedback_1_rpm2_from(v[3]),
        .esc_current2 = modcube_esc_feedback_1_esc_current2_from(v[4]),
        .esc_status2 = (uint8_t)v[5],
    };
    modcube_esc_feedback_1_pack(data, &esc, MESSAGE_BYTES);
}

static void pack_power(uint8_t *data, const double *v)
{
    struct modcube_power_t power = {
        .voltage = modcube_power_voltage_from(v[0]),
        .current = modcube_power_current_from(v[1]),
        .power_status = (uint8_t)v[2],
    };
    modcube_power_pack(data, &power, MESSAGE_BYTES);
}

static void pack_environment(uint8_t *data, const double *v)
{
    struct modcube_environment_t environment = {
        .cabin_temperature = modcube_environment_cabin_temperature_from(v[0]),
        .cabin_pressure = modcube_environment_cabin_pressure_from(v[1]),
        .leak = v[2] != 0.0,
    };
    modcube_environment_pack(data, &environment, MESSAGE_BYTES);
}

/* Both docking messages share one layout, and so do all four ESC messages (tests compare them with the DBC). */
static void send_slow(struct node *node, int slow, const struct node_readings *r)
{
    uint8_t data[MESSAGE_BYTES];
    enum modcube_message_index message = (enum modcube_message_index)(FIRST_SLOW + slow);
    switch (message) {
    case MODCUBE_DEPTH: pack_depth(data, r); break;
    case MODCUBE_DOCK_CURRENT_ABC: pack_dock(data, r->dock[0]); break;
    case MODCUBE_DOCK_CURRENT_DEF: pack_dock(data, r->dock[1]); break;
    case MODCUBE_POWER: pack_power(data, r->power); break;
    case MODCUBE_ENVIRONMENT: pack_environment(data, r->environment); break;
    default: pack_esc(data, r->esc[message - MODCUBE_ESC_FEEDBACK_1]); break;
    }
    send(node, message, data, node->counters[slow]++);
}

static void send_status(struct node *node, uint32_t tick, uint8_t errors, uint8_t state)
{
    uint8_t data[MESSAGE_BYTES];
    struct modcube_mcu_status_t status = {
        .status_tick = (uint16_t)tick, .version = NODE_VERSION, .errors = errors, .state = state,
    };
    modcube_mcu_status_pack(data, &status, sizeof data);
    send(node, MODCUBE_MCU_STATUS, data, (uint8_t)tick);
}

/* Applies the last accepted command; returns the resulting state. */
static uint8_t apply_command(struct node *node, int64_t now_ns)
{
    double thruster[NODE_THRUSTERS];
    bool timed_out = false, disarmed = false;
    for (int half = 0; half < 2; half++) {
        bool live = is_live(node, half, now_ns);
        timed_out = timed_out || !live;
        disarmed = disarmed || (live && !node->armed[half]);  /* one live half that is not armed disarms both */
    }
    for (int i = 0; i < NODE_THRUSTERS; i++) {
        bool allowed = is_live(node, i / 4, now_ns) && !disarmed && !node->stopped;
        thruster[i] = allowed ? node->command[i] : 0.0;
    }
    apply(node, thruster);
    return node->stopped ? STATE_ESTOP : timed_out ? STATE_TIMEOUT : disarmed ? STATE_DISARMED : STATE_ARMED;
}

static void take_sync(struct node *node, const uint8_t *data, int64_t now_ns)
{
    struct modcube_sync_t sync;
    modcube_sync_unpack(&sync, data, MESSAGE_BYTES);
    node->applied.tick = sync.tick;
    uint8_t state = apply_command(node, now_ns);
    uint32_t due = 0u;
    for (int slow = 0; slow < NODE_SLOW; slow++) {
        enum modcube_message_index message = (enum modcube_message_index)(FIRST_SLOW + slow);
        due |= (uint32_t)modcube_is_due(message, node->receiver.number, sync.tick, node->rate_hz) << slow;
    }
    struct node_readings readings;
    memset(&readings, 0, sizeof readings);
    if (!node->hardware.sample(node->hardware.context, due, &readings)) {
        due = 0u;
        readings.gyro[3] = readings.accel[3] = SENSOR_FAULT;
        node->errors |= ERROR_SENSOR;
    }
    send_inertial(node, &readings, (uint8_t)sync.tick);
    for (int slow = 0; slow < NODE_SLOW; slow++) {
        if ((due >> slow & 1u) != 0u) {
            send_slow(node, slow, &readings);
        }
    }
    bool timed_out = !is_live(node, 0, now_ns) || !is_live(node, 1, now_ns);
    uint8_t errors = (uint8_t)(node->errors | (timed_out ? ERROR_TIMEOUT : 0));
    node->errors = 0u;
    send_status(node, sync.tick, errors, state);
}

/* Records a dropped frame that was meant for this node, for the next status. */
static void blame(struct node *node, const uint32_t *before)
{
    const uint32_t *now = node->receiver.dropped;
    node->errors |= now[MODCUBE_DROP_CRC] != before[MODCUBE_DROP_CRC] ? ERROR_CRC : 0;
    node->errors |= now[MODCUBE_DROP_COUNTER] != before[MODCUBE_DROP_COUNTER] ? ERROR_COUNTER : 0;
    node->errors |= now[MODCUBE_DROP_LENGTH] != before[MODCUBE_DROP_LENGTH] ? ERROR_LENGTH : 0;
}

void node_take(struct node *node, uint16_t id, const uint8_t *data, size_t length, int64_t now_ns)
{
    static const double ZERO[NODE_THRUSTERS] = {0.0};
    uint32_t before[MODCUBE_DROP_KINDS];
    memcpy(before, node->receiver.dropped, sizeof before);
    switch (modcube_accept(&node->receiver, id, data, length)) {
    case MODCUBE_ESTOP:
        node->stopped = true;
        node->stopped_ns = now_ns;
        end_push(node);
        apply(node, ZERO);
        break;
    case MODCUBE_SYNC: take_sync(node, data, now_ns); break;
    case MODCUBE_THRUSTER_CMD_A: take_command_a(node, data, now_ns); break;
    case MODCUBE_THRUSTER_CMD_B: take_command_b(node, data, now_ns); break;
    case MODCUBE_DOCK_CMD: take_dock(node, data, now_ns); break;
    case MODCUBE_DROPPED:
        if ((id & MODCUBE_NUMBER_MASK) == node->receiver.number) {
            blame(node, before);
        }
        break;
    default: break;
    }
}

void node_watch(struct node *node, int64_t now_ns)
{
    double thruster[NODE_THRUSTERS];
    bool ends = now_ns - node->docked_ns > NODE_PUSH_NS && end_push(node);
    for (int i = 0; i < NODE_THRUSTERS; i++) {
        bool live = is_live(node, i / 4, now_ns);
        if (!live) {
            node->armed[i / 4] = false;
        }
        thruster[i] = live ? node->applied.thruster[i] : 0.0;
        ends = ends || thruster[i] != node->applied.thruster[i];
    }
    if (ends) {
        apply(node, thruster);
    }
}
