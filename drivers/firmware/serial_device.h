/* The device's end of Bramah's serial wire (docs/wire-serial.md): sample clock, output laws,
 * blocks, watchdog. Portable C99, no allocation, no calls to an operating system.
 *
 * A firmware supplies two functions of its board (`sd_board`), calls `sd_tick` from its sample
 * clock and the others from its main loop. None of them may interrupt another one on the same
 * device: where `sd_tick` runs in an interrupt, mask that interrupt around the others.
 */
#ifndef SERIAL_DEVICE_H
#define SERIAL_DEVICE_H

#include <stddef.h>
#include <stdint.h>

#ifndef SD_MAX_JOINTS
#define SD_MAX_JOINTS 9
#endif
#ifndef SD_WAVE_CAPACITY /* longest waveform of a joint [samples]; two of them are stored */
#define SD_WAVE_CAPACITY 131072
#endif
#ifndef SD_QUEUE_BLOCKS /* blocks kept until acknowledged: 4 s at 1 kHz */
#define SD_QUEUE_BLOCKS 400
#endif

#define SD_MAX_CHANNELS 119
#define SD_BLOCK_BYTES 240   /* samples of a block */
#define SD_MAX_PAYLOAD 252
#define SD_MAX_BODY (12 + SD_MAX_PAYLOAD) /* header, payload, CRC */
#define SD_MAX_FRAME (SD_MAX_BODY + 2 + 2) /* stuffed, between two zeros */

/* One joint's converters. */
typedef struct {
    float command_range;     /* [V], either way */
    unsigned command_bits;   /* two's complement */
    unsigned piston_channel; /* place of its piston among the channels */
    float piston_low;        /* [m] at code 0 */
    float piston_high;       /* [m] at the highest code */
    unsigned piston_bits;    /* offset binary */
} sd_joint;

/* What the device is; it has to fit the rig file of the host. */
typedef struct {
    const char *name; /* of the rig; up to 32 characters count */
    float sample_rate; /* [Hz] */
    uint32_t converter_checksum;
    unsigned channels;
    unsigned joints;
    int virtual_time; /* 0: real time. 1: `sd_tick` is called while `sd_wants_tick` says so */
    sd_joint joint[SD_MAX_JOINTS];
} sd_config;

/* What the protocol needs of a board. */
typedef struct {
    void (*measure)(void *context, uint16_t *codes); /* all channels, AD codes */
    void (*output)(void *context, const int16_t *codes); /* all joints, DA codes */
    void *context;
} sd_board;

typedef struct {
    float gain, bias, position_gain, setpoint, limit;
} sd_law;

typedef struct {
    int16_t samples[2][SD_WAVE_CAPACITY]; /* the one in use and the one uploaded */
    uint32_t length[2];
    uint8_t active; /* which of the two is in use */
    uint8_t ready;  /* the other one is complete */
    uint64_t start; /* tick of the first sample */
} sd_wave;

typedef struct {
    uint16_t sequence;
    uint64_t tick;
    uint8_t samples[SD_BLOCK_BYTES];
} sd_block;

typedef struct {
    sd_config config;
    sd_board board;
    unsigned block_samples;

    uint64_t tick;
    uint64_t apply_tick;
    uint64_t trip_tick;
    uint16_t cause;
    uint16_t refusal, refusal_joint;
    int streaming;
    sd_law law[SD_MAX_JOINTS];
    sd_wave wave[SD_MAX_JOINTS];
    int16_t outputs[SD_MAX_JOINTS];

    unsigned upload_joint; /* 1-based, 0: none open */
    uint32_t upload_done;

    sd_block queue[SD_QUEUE_BLOCKS];
    unsigned queue_first, queue_count;
    sd_block filling;
    unsigned filled; /* samples */
    uint16_t next_sequence;
    uint16_t next_sent;
    uint32_t dropped;
    uint16_t stream_number;
    int wanted;

    int known; /* a host has opened a session */
    int controlled;
    uint32_t session;
    uint16_t number; /* of the newest request */
    uint16_t heartbeat;
    uint32_t heard_ms;
    uint32_t watchdog_ms;

    uint8_t received[SD_MAX_FRAME];
    size_t received_size;
    int skipping;
    uint32_t damaged;

    uint8_t remembered[SD_MAX_FRAME]; /* answer to the newest request */
    size_t remembered_size;
    uint8_t answer[SD_MAX_FRAME];
    size_t answer_size;
    uint8_t sending[SD_MAX_FRAME];
    size_t sending_size, sent;
} sd_device;

/* Make a device with all outputs at zero and put them out. */
void sd_init(sd_device *device, const sd_config *config, const sd_board *board);

/* Carry out what these bytes complete; `now_ms` is any clock of milliseconds that may overflow. */
void sd_receive(sd_device *device, const uint8_t *data, size_t size, uint32_t now_ms);

/* Fill `data` with bytes to be sent next; returns how many, 0 when there is nothing to send. */
size_t sd_transmit(sd_device *device, uint8_t *data, size_t room);

/* Take one sample: measure, evaluate the laws, put out; at the sample rate. */
void sd_tick(sd_device *device);

/* Whether another sample is wanted; only in virtual time. */
int sd_wants_tick(const sd_device *device);

/* Zero the outputs if the host has been silent for too long; at least every 5 ms. */
void sd_poll(sd_device *device, uint32_t now_ms);

/* Say that the host's end of the line was closed (DTR fell, USB suspended), where that is seen. */
void sd_host_lost(sd_device *device);

/* Say that the board is in fault: outputs to zero, latched until reset. */
void sd_fault(sd_device *device);

#endif
