/* See serial_device.h and docs/wire-serial.md. Sections: bytes, frames, outputs, requests,
 * stream, the public functions. */
#include "serial_device.h"

#include <string.h>

enum { VERSION = 1, ANSWER = 0x80, WINDOW = 8, HEADER = 8, CHECK = 4, PAGE_SAMPLES = 121 };
enum { VIRTUAL_SILENCE_MS = 10000, WATCHDOG_LEAST_MS = 20, WATCHDOG_MOST_MS = 10000 };
enum { LAW_BYTES = 20, IDENTITY_BYTES = 64, NAME_AT = 32, NAME_BYTES = 32 };
static const uint32_t MAGIC = 0x4252414DUL; /* "BRAM" */
static const uint16_t RESET_KEY = 0x5253;

enum message {
    IDENTIFY = 0x01, STATUS = 0x02, ZERO = 0x03,
    OPEN = 0x10, CLOSE = 0x11, START = 0x12, STOP = 0x13, APPLY = 0x14, RESET = 0x15,
    UPLOAD_BEGIN = 0x18, UPLOAD_PAGE = 0x19, UPLOAD_END = 0x1A,
    ALIVE_NOTE = 0x20, BLOCK = 0x40, REFUSED = 0xFF
};
enum cause { NOT_TRIPPED, WATCHDOG, HOST_LOST, FAULT };
enum refusal {
    OBEYED, NOT_IN_CONTROL, TRIPPED, NOT_FINITE, OUT_OF_RANGE, NO_SUCH_REQUEST, UPLOAD_TORN,
    IN_FAULT
};
enum status { IS_STREAMING = 1, IS_TRIPPED = 2, IS_ARMED = 4, HAS_BLOCK = 8, IS_CONTROLLED = 16 };

/* What a request is answered with. */
typedef struct {
    enum refusal refusal;
    unsigned joint; /* 1-based, 0: none */
    uint8_t payload[SD_MAX_PAYLOAD];
    size_t size;
} reply;

/* -- bytes ------------------------------------------------------------------------------- */

static void put16(uint8_t *at, uint32_t value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
}

static void put32(uint8_t *at, uint32_t value)
{
    put16(at, value >> 16);
    put16(at + 2, value & 0xFFFFU);
}

static uint16_t get16(const uint8_t *at)
{
    return (uint16_t)((uint16_t)at[0] << 8 | at[1]);
}

static uint32_t get32(const uint8_t *at)
{
    return (uint32_t)get16(at) << 16 | get16(at + 2);
}

static void put_float(uint8_t *at, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put32(at, bits);
}

static float get_float(const uint8_t *at)
{
    uint32_t bits = get32(at);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static int is_finite(const uint8_t *at)
{
    return (get32(at) & 0x7F800000UL) != 0x7F800000UL;
}

/* CRC-32 as zlib's: continue from `crc`, which begins as 0. */
static uint32_t crc32(uint32_t crc, const uint8_t *data, size_t size)
{
    crc = ~crc;
    while (size--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (0xEDB88320UL & (0UL - (crc & 1U)));
    }
    return ~crc & 0xFFFFFFFFUL;
}

/* -- frames ------------------------------------------------------------------------------ */

/* Write a whole frame with its zeros to `wire` (SD_MAX_FRAME bytes); returns its size. */
static size_t make_frame(uint8_t *wire, unsigned type, uint16_t number, uint32_t session,
                         const uint8_t *payload, size_t payload_size)
{
    uint8_t body[SD_MAX_BODY];
    size_t size = HEADER + payload_size, code_at = 1, end = 2;
    body[0] = VERSION;
    body[1] = (uint8_t)type;
    put16(body + 2, number);
    put32(body + 4, session);
    if (payload_size) /* memcpy must not be given a null pointer, even for nothing */
        memcpy(body + HEADER, payload, payload_size);
    put32(body + size, crc32(0, body, size));
    size += CHECK;
    wire[0] = 0;
    for (size_t at = 0; at < size; at++) {
        if (body[at])
            wire[end++] = body[at];
        /* A group ends with a zero, or when it is as long as its code can say. */
        if (!body[at] || (end - code_at == 0xFF && at + 1 < size)) {
            wire[code_at] = (uint8_t)(end - code_at);
            code_at = end++;
        }
    }
    wire[code_at] = (uint8_t)(end - code_at);
    wire[end++] = 0;
    return end;
}

/* Undo the stuffing in place; returns the size of the body, 0 if it is none. */
static size_t unstuff(uint8_t *data, size_t size)
{
    size_t from = 0, to = 0;
    while (from < size) {
        unsigned code = data[from++];
        if (from + code - 1 > size)
            return 0;
        for (unsigned k = 1; k < code; k++)
            data[to++] = data[from++];
        if (code < 0xFF && from < size)
            data[to++] = 0;
    }
    if (to < HEADER + CHECK || to > SD_MAX_BODY)
        return 0;
    to -= CHECK;
    return crc32(0, data, to) == get32(data + to) ? to : 0;
}

/* -- outputs ----------------------------------------------------------------------------- */

static int is_armed(const sd_device *d)
{
    for (unsigned j = 0; j < d->config.joints; j++)
        if (d->law[j].limit > 0.0F)
            return 1;
    return 0;
}

static void zero_outputs(sd_device *d)
{
    memset(d->law, 0, sizeof d->law);
    memset(d->outputs, 0, sizeof d->outputs);
    d->board.output(d->board.context, d->outputs);
}

static void clear_queue(sd_device *d)
{
    d->queue_first = d->queue_count = 0;
    d->filled = 0;
    d->next_sequence = d->next_sent = 0;
    d->dropped = 0;
    d->wanted = 0;
}

static void stop_stream(sd_device *d)
{
    d->streaming = 0;
    clear_queue(d);
}

static void trip(sd_device *d, enum cause cause)
{
    zero_outputs(d);
    if (d->cause == NOT_TRIPPED) {
        d->cause = (uint16_t)cause;
        d->trip_tick = d->tick;
    }
}

/* v = clip(gain wave + bias + position_gain (setpoint - s), +-limit), as a DA code. */
static int16_t evaluate(const sd_device *d, unsigned j, const uint16_t *codes)
{
    const sd_joint *joint = &d->config.joint[j];
    const sd_law *law = &d->law[j];
    const sd_wave *wave = &d->wave[j];
    const float top = (float)((1UL << (joint->command_bits - 1)) - 1);
    const float piston_top = (float)((1UL << joint->piston_bits) - 1);
    float limit = law->limit < joint->command_range ? law->limit : joint->command_range;
    uint32_t length = wave->length[wave->active];
    float w = 0.0F, volts, s;
    if (!(limit > 0.0F))
        return 0;
    if (length)
        w = (float)wave->samples[wave->active][(d->tick - wave->start) % length]
            * (joint->command_range / 32767.0F);
    s = joint->piston_low + (float)codes[joint->piston_channel]
        * ((joint->piston_high - joint->piston_low) / piston_top);
    volts = law->gain * w + law->bias + law->position_gain * (law->setpoint - s);
    if (volts > limit)
        volts = limit;
    else if (volts < -limit)
        volts = -limit;
    else if (!(volts >= -limit)) /* not a number */
        volts = 0.0F;
    volts *= top / joint->command_range;
    return (int16_t)(volts < 0.0F ? volts - 0.5F : volts + 0.5F);
}

/* -- requests ---------------------------------------------------------------------------- */

static void refuse(reply *r, enum refusal refusal, unsigned joint)
{
    r->refusal = refusal;
    r->joint = joint;
}

static uint16_t status_bits(const sd_device *d)
{
    return (uint16_t)((d->streaming ? IS_STREAMING : 0) | (d->cause ? IS_TRIPPED : 0)
                      | (is_armed(d) ? IS_ARMED : 0) | (d->controlled ? IS_CONTROLLED : 0));
}

static void identify(const sd_device *d, reply *r)
{
    uint8_t *at = r->payload;
    size_t name = strlen(d->config.name);
    memset(at, 0, IDENTITY_BYTES);
    put32(at, MAGIC);
    put16(at + 4, 1);
    put16(at + 6, d->config.joints);
    put16(at + 8, d->config.channels);
    put_float(at + 10, d->config.sample_rate);
    put16(at + 14, d->block_samples);
    put16(at + 16, d->config.virtual_time ? 1 : 0);
    put32(at + 18, SD_WAVE_CAPACITY);
    put32(at + 22, d->config.converter_checksum);
    memcpy(at + NAME_AT, d->config.name, name < NAME_BYTES ? name : NAME_BYTES);
    r->size = IDENTITY_BYTES;
}

static void tell_status(const sd_device *d, reply *r)
{
    uint8_t *at = r->payload;
    memset(at, 0, 50);
    put16(at, status_bits(d));
    put16(at + 2, d->cause);
    put32(at + 4, (uint32_t)d->trip_tick);
    put32(at + 8, (uint32_t)d->tick);
    put16(at + 12, d->next_sequence);
    put16(at + 14, d->queue_count);
    put32(at + 16, d->dropped);
    put32(at + 20, (uint32_t)d->apply_tick);
    put16(at + 24, d->refusal);
    put16(at + 26, d->refusal_joint);
    for (unsigned j = 0; j < d->config.joints; j++)
        put16(at + 32 + 2 * j, (uint16_t)d->outputs[j]);
    r->size = 50;
}

static void open_session(sd_device *d, uint16_t number, uint32_t session, const uint8_t *payload,
                         reply *r)
{
    uint16_t watchdog = get16(payload);
    if (d->controlled && !(d->known && session == d->session)) {
        refuse(r, NOT_IN_CONTROL, 0);
        return;
    }
    if (watchdog < WATCHDOG_LEAST_MS || watchdog > WATCHDOG_MOST_MS) {
        refuse(r, OUT_OF_RANGE, 0);
        return;
    }
    d->known = d->controlled = 1;
    d->session = session;
    d->number = number;
    d->watchdog_ms = watchdog;
    zero_outputs(d);
    stop_stream(d);
}

static void start_stream(sd_device *d)
{
    clear_queue(d);
    for (unsigned j = 0; j < d->config.joints; j++)
        d->wave[j].start = d->tick;
    d->stream_number = d->number;
    d->streaming = 1;
}

static void apply(sd_device *d, const uint8_t *payload, reply *r)
{
    sd_law laws[SD_MAX_JOINTS];
    uint16_t flag = get16(payload);
    int arms = 0;
    for (unsigned j = 0; j < d->config.joints; j++) {
        const sd_joint *joint = &d->config.joint[j];
        const float volts = joint->command_range;
        const float low = joint->piston_low < 0.0F ? -joint->piston_low : joint->piston_low;
        const float high = joint->piston_high < 0.0F ? -joint->piston_high : joint->piston_high;
        const float most[5] = {100.0F, volts, 1e5F, low > high ? low : high, volts};
        const uint8_t *at = payload + 2 + LAW_BYTES * j;
        float value[5];
        for (unsigned k = 0; k < 5; k++)
            if (!is_finite(at + 4 * k)) {
                refuse(r, NOT_FINITE, j + 1);
                return;
            }
        for (unsigned k = 0; k < 5; k++) {
            value[k] = get_float(at + 4 * k);
            if (value[k] > most[k] * 1.000001F || value[k] < -most[k] * 1.000001F
                || (k == 4 && value[k] < 0.0F)) {
                refuse(r, OUT_OF_RANGE, j + 1);
                return;
            }
        }
        laws[j].gain = value[0];
        laws[j].bias = value[1];
        laws[j].position_gain = value[2];
        laws[j].setpoint = value[3];
        laws[j].limit = value[4];
        arms |= value[4] > 0.0F;
    }
    if (flag != 1 && flag != 3) {
        refuse(r, OUT_OF_RANGE, 0);
        return;
    }
    if (d->cause && arms) {
        refuse(r, TRIPPED, 0);
        return;
    }
    for (unsigned j = 0; j < d->config.joints; j++) {
        sd_wave *wave = &d->wave[j];
        d->law[j] = laws[j];
        if (wave->ready) {
            wave->active ^= 1U;
            wave->ready = 0;
        }
        if (flag == 3)
            wave->start = d->tick;
    }
    d->apply_tick = d->tick;
    put32(r->payload, (uint32_t)d->tick);
    r->size = 4;
}

static void begin_upload(sd_device *d, const uint8_t *payload, reply *r)
{
    unsigned joint = get16(payload);
    uint32_t length = get32(payload + 2);
    d->upload_joint = 0;
    if (joint < 1 || joint > d->config.joints || length < 1 || length > SD_WAVE_CAPACITY) {
        refuse(r, OUT_OF_RANGE, joint);
        return;
    }
    d->upload_joint = joint;
    d->upload_done = 0;
    d->wave[joint - 1].ready = 0;
    d->wave[joint - 1].length[d->wave[joint - 1].active ^ 1U] = length;
}

/* Pages come in order: one that leaves a gap is refused when the upload ends. */
static void take_page(sd_device *d, const uint8_t *payload, size_t size, reply *r)
{
    uint32_t offset = get32(payload), count = (uint32_t)(size - 4) / 2;
    sd_wave *wave;
    unsigned spare;
    if (!d->upload_joint) {
        refuse(r, UPLOAD_TORN, 0);
        return;
    }
    wave = &d->wave[d->upload_joint - 1];
    spare = wave->active ^ 1U;
    if (offset > wave->length[spare] || count > wave->length[spare] - offset) {
        refuse(r, OUT_OF_RANGE, d->upload_joint);
        return;
    }
    for (uint32_t k = 0; k < count; k++)
        wave->samples[spare][offset + k] = (int16_t)get16(payload + 4 + 2 * k);
    if (offset <= d->upload_done && offset + count > d->upload_done)
        d->upload_done = offset + count;
}

static void end_upload(sd_device *d, const uint8_t *payload, reply *r)
{
    unsigned joint = d->upload_joint;
    uint32_t crc = 0;
    sd_wave *wave;
    unsigned spare;
    d->upload_joint = 0;
    if (!joint) {
        refuse(r, UPLOAD_TORN, 0);
        return;
    }
    wave = &d->wave[joint - 1];
    spare = wave->active ^ 1U;
    for (uint32_t k = 0; k < wave->length[spare]; k++) {
        uint8_t sample[2];
        put16(sample, (uint16_t)wave->samples[spare][k]);
        crc = crc32(crc, sample, 2);
    }
    if (d->upload_done != wave->length[spare] || crc != get32(payload)) {
        refuse(r, UPLOAD_TORN, joint);
        return;
    }
    wave->ready = 1;
}

/* Whether a request's payload has the size that its type asks for. */
static int has_its_size(const sd_device *d, unsigned type, size_t size)
{
    switch (type) {
    case IDENTIFY: case STATUS: case ZERO: case CLOSE: case START: case STOP:
        return size == 0;
    case OPEN: case RESET:
        return size == 2;
    case UPLOAD_END:
        return size == 4;
    case UPLOAD_BEGIN:
        return size == 6;
    case UPLOAD_PAGE:
        return size >= 6 && size <= 4 + 2 * PAGE_SAMPLES && size % 2 == 0;
    case APPLY:
        return size == 2 + LAW_BYTES * d->config.joints;
    default:
        return 0;
    }
}

static int is_for_anybody(unsigned type)
{
    return type == IDENTIFY || type == STATUS || type == ZERO;
}

static void carry_out(sd_device *d, const uint8_t *body, size_t size, uint32_t now_ms, reply *r)
{
    unsigned type = body[1];
    uint16_t number = get16(body + 2);
    uint32_t session = get32(body + 4);
    const uint8_t *payload = body + HEADER;
    int known = d->known && session == d->session;
    if (body[0] != VERSION || !has_its_size(d, type, size - HEADER)) {
        refuse(r, NO_SUCH_REQUEST, 0);
        return;
    }
    if (type == IDENTIFY) {
        identify(d, r);
        return;
    }
    if (type == STATUS) {
        tell_status(d, r);
        return;
    }
    if (type == ZERO) {
        zero_outputs(d);
        return;
    }
    if (type == OPEN) {
        open_session(d, number, session, payload, r);
        if (r->refusal == OBEYED)
            d->heard_ms = now_ms;
        return;
    }
    if (!known) {
        refuse(r, NOT_IN_CONTROL, 0);
        return;
    }
    d->controlled = 1;
    d->heard_ms = now_ms;
    switch (type) {
    case CLOSE:
        zero_outputs(d);
        stop_stream(d);
        d->controlled = 0;
        break;
    case START:
        start_stream(d);
        break;
    case STOP:
        stop_stream(d);
        break;
    case APPLY:
        apply(d, payload, r);
        break;
    case RESET:
        if (get16(payload) != RESET_KEY)
            refuse(r, OUT_OF_RANGE, 0);
        else if (d->cause == FAULT)
            refuse(r, IN_FAULT, 0);
        else
            d->cause = NOT_TRIPPED;
        break;
    case UPLOAD_BEGIN:
        begin_upload(d, payload, r);
        break;
    case UPLOAD_PAGE:
        take_page(d, payload, size - HEADER, r);
        break;
    default: /* UPLOAD_END */
        end_upload(d, payload, r);
        break;
    }
}

/* -- stream ------------------------------------------------------------------------------ */

static void take_note(sd_device *d, const uint8_t *body, size_t size, uint32_t now_ms)
{
    const uint8_t *payload = body + HEADER;
    unsigned count;
    if (body[0] != VERSION || size != HEADER + 6 || !d->known || get32(body + 4) != d->session)
        return;
    d->controlled = 1;
    if (get16(payload + 2) != d->heartbeat)
        d->heard_ms = now_ms;
    d->heartbeat = get16(payload + 2);
    if (get16(body + 2) != d->stream_number || !d->streaming)
        return;
    if (d->queue_count) {
        count = (uint16_t)(get16(payload) - d->queue[d->queue_first].sequence) + 1U;
        if (count <= d->queue_count) {
            d->queue_first = (d->queue_first + count) % SD_QUEUE_BLOCKS;
            d->queue_count -= count;
        }
    }
    if ((get16(payload + 4) & 1U) && d->queue_count)
        d->next_sent = d->queue[d->queue_first].sequence;
    d->wanted = 1;
}

/* Put the next block that may be sent into `sending`; nothing if none may. */
static void send_block(sd_device *d)
{
    uint8_t payload[12 + SD_BLOCK_BYTES];
    const sd_block *block;
    uint16_t oldest, place;
    size_t size = 2U * d->block_samples * (d->config.channels + d->config.joints);
    if (!d->known || !d->streaming || !d->queue_count)
        return;
    oldest = d->queue[d->queue_first].sequence;
    place = (uint16_t)(d->next_sent - oldest);
    if (place > d->queue_count)
        place = 0; /* what would have been next was dropped */
    if (place == d->queue_count || place >= WINDOW)
        return;
    block = &d->queue[(d->queue_first + place) % SD_QUEUE_BLOCKS];
    put16(payload, oldest);
    put16(payload + 2, block->sequence);
    put32(payload + 4, (uint32_t)block->tick);
    put16(payload + 8, (uint16_t)(status_bits(d) | HAS_BLOCK));
    put16(payload + 10, d->queue_count - place - 1U);
    memcpy(payload + 12, block->samples, size);
    d->next_sent = (uint16_t)(block->sequence + 1U);
    d->sending_size = make_frame(d->sending, BLOCK, d->stream_number, d->session, payload,
                                 12 + size);
}

static void keep_sample(sd_device *d, const uint16_t *codes)
{
    unsigned columns = d->config.channels + d->config.joints;
    uint8_t *at = d->filling.samples + 2U * columns * d->filled;
    if (!d->filled)
        d->filling.tick = d->tick;
    for (unsigned c = 0; c < d->config.channels; c++, at += 2)
        put16(at, codes[c]);
    for (unsigned j = 0; j < d->config.joints; j++, at += 2)
        put16(at, (uint16_t)d->outputs[j]);
    if (++d->filled < d->block_samples)
        return;
    d->filled = 0;
    if (d->queue_count == SD_QUEUE_BLOCKS) {
        d->queue_first = (d->queue_first + 1) % SD_QUEUE_BLOCKS;
        d->queue_count--;
        d->dropped++;
    }
    d->filling.sequence = d->next_sequence++;
    d->queue[(d->queue_first + d->queue_count++) % SD_QUEUE_BLOCKS] = d->filling;
    d->wanted = 0;
}

/* Carry out one whole frame; a request of this session that is older than one carried out is
 * dropped, the newest one that comes again is answered as before. */
static void take_frame(sd_device *d, const uint8_t *body, size_t size, uint32_t now_ms)
{
    unsigned type = body[1];
    uint16_t number = get16(body + 2);
    uint32_t session = get32(body + 4);
    int anybody = is_for_anybody(type);
    reply r;
    if (type == ALIVE_NOTE) {
        take_note(d, body, size, now_ms);
        return;
    }
    if (d->known && session == d->session && body[0] == VERSION) {
        uint16_t age = (uint16_t)(number - d->number);
        if (!anybody && age == 0 && d->remembered_size) {
            memcpy(d->answer, d->remembered, d->remembered_size);
            d->answer_size = d->remembered_size;
            return;
        }
        if (!anybody && (age == 0 || age >= 0x8000U))
            return;
        if (age > 0 && age < 0x8000U) {
            d->number = number;
            d->remembered_size = 0;
        }
    }
    memset(&r, 0, sizeof r);
    carry_out(d, body, size, now_ms, &r);
    if (r.refusal != OBEYED) {
        d->refusal = (uint16_t)r.refusal;
        d->refusal_joint = (uint16_t)r.joint;
        put16(r.payload, r.refusal);
        put16(r.payload + 2, r.joint);
        r.size = 4;
        type = REFUSED;
    } else {
        type |= ANSWER;
    }
    d->answer_size = make_frame(d->answer, type, number, session, r.payload, r.size);
    if (!anybody && d->known && session == d->session) {
        memcpy(d->remembered, d->answer, d->answer_size);
        d->remembered_size = d->answer_size;
    }
}

/* -- public ------------------------------------------------------------------------------ */

void sd_init(sd_device *d, const sd_config *config, const sd_board *board)
{
    unsigned columns = config->channels + config->joints;
    memset(d, 0, sizeof *d);
    d->config = *config;
    d->board = *board;
    d->block_samples = 120 / columns < 10 ? 120 / columns : 10;
    zero_outputs(d);
}

void sd_receive(sd_device *d, const uint8_t *data, size_t size, uint32_t now_ms)
{
    for (; size; size--, data++) {
        if (*data) {
            if (d->received_size < sizeof d->received)
                d->received[d->received_size++] = *data;
            else
                d->skipping = 1; /* too long for a frame */
            continue;
        }
        if (d->received_size) {
            size_t body = d->skipping ? 0 : unstuff(d->received, d->received_size);
            if (body)
                take_frame(d, d->received, body, now_ms);
            else
                d->damaged++;
        }
        d->received_size = 0;
        d->skipping = 0;
    }
}

size_t sd_transmit(sd_device *d, uint8_t *data, size_t room)
{
    size_t count = 0;
    while (count < room) {
        size_t part;
        if (d->sent == d->sending_size) {
            d->sent = d->sending_size = 0;
            if (d->answer_size) {
                memcpy(d->sending, d->answer, d->answer_size);
                d->sending_size = d->answer_size;
                d->answer_size = 0;
            } else {
                send_block(d);
            }
            if (!d->sending_size)
                break;
        }
        part = d->sending_size - d->sent;
        if (part > room - count)
            part = room - count;
        memcpy(data + count, d->sending + d->sent, part);
        d->sent += part;
        count += part;
    }
    return count;
}

void sd_tick(sd_device *d)
{
    uint16_t codes[SD_MAX_CHANNELS];
    d->board.measure(d->board.context, codes);
    for (unsigned j = 0; j < d->config.joints; j++)
        d->outputs[j] = evaluate(d, j, codes);
    d->board.output(d->board.context, d->outputs);
    if (d->streaming)
        keep_sample(d, codes);
    d->tick++;
}

int sd_wants_tick(const sd_device *d)
{
    return d->config.virtual_time && d->streaming && d->wanted && !d->queue_count;
}

void sd_poll(sd_device *d, uint32_t now_ms)
{
    uint32_t allowed = d->watchdog_ms;
    if (d->config.virtual_time && allowed < VIRTUAL_SILENCE_MS)
        allowed = VIRTUAL_SILENCE_MS;
    if (d->controlled && (uint32_t)(now_ms - d->heard_ms) > allowed) {
        d->controlled = 0;
        if (d->streaming || is_armed(d))
            trip(d, WATCHDOG);
    }
}

void sd_host_lost(sd_device *d)
{
    int busy = d->streaming || is_armed(d);
    d->received_size = 0;
    d->skipping = 0;
    d->known = 0;
    if (!d->controlled)
        return;
    d->controlled = 0;
    if (busy) {
        trip(d, HOST_LOST);
        stop_stream(d);
    }
}

void sd_fault(sd_device *d)
{
    trip(d, FAULT);
}
