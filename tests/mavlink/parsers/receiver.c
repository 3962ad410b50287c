/* A receiver made of MAVLink's C library: which frames it accepts in a stream, from where it may begin or resume.
 *
 * Compiled once for each dialect and version of the library. The library's parser is called byte by byte, as autopilots
 * and ground stations do; this file keeps only the place of each accepted frame.
 */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#if defined(ACCEPTS_UNKNOWN) || defined(OTHER_DEFINITIONS)
/* ACCEPTS_UNKNOWN: releases before 2025 took 0 for the CRC_EXTRA of a message that they did not know.
 * OTHER_DEFINITIONS: {message, CRC_EXTRA} of a dialect that defines these messages otherwise.
 */
#define MAVLINK_GET_MSG_ENTRY
#include "mavlink_types.h"
static const mavlink_msg_entry_t *mavlink_get_msg_entry(uint32_t msgid);
#endif
#include "mavlink.h"

#if defined(ACCEPTS_UNKNOWN) || defined(OTHER_DEFINITIONS)
static const mavlink_msg_entry_t *mavlink_get_msg_entry(uint32_t msgid)
{
    static const mavlink_msg_entry_t known[] = MAVLINK_MESSAGE_CRCS;
    static mavlink_msg_entry_t unknown;
#ifdef OTHER_DEFINITIONS
    static const uint32_t others[][2] = OTHER_DEFINITIONS;
    for (unsigned k = 0; k < sizeof(others) / sizeof(others[0]); k++) {
        if (others[k][0] == msgid) {
            memset(&unknown, 0, sizeof(unknown));
            unknown.msgid = msgid;
            unknown.crc_extra = (uint8_t)others[k][1];
            return &unknown;
        }
    }
#endif
    int low = 0, high = (int)(sizeof(known) / sizeof(known[0])) - 1;
    while (low <= high) {
        int middle = (low + high) / 2;
        if (known[middle].msgid == msgid) {
            return &known[middle];
        }
        if (known[middle].msgid < msgid) {
            low = middle + 1;
        } else {
            high = middle - 1;
        }
    }
#ifdef OTHER_DEFINITIONS
    return NULL;
#else
    memset(&unknown, 0, sizeof(unknown));
    unknown.msgid = msgid;
    return &unknown;
#endif
}
#endif

#ifdef MAVLINK_STX_MAVLINK1
#define VERSION 2
#define START1 MAVLINK_STX_MAVLINK1
#else
#define VERSION 1
#define START1 MAVLINK_STX
#endif

enum { RESUMES = 1, NO_MAVLINK1 = 2, SIGNS = 4, TAKES_UNSIGNED = 8 };
enum { STATES = 32, LONGEST_LOSS = 300 };

typedef struct {
    int32_t stream;    /* which of the streams */
    int32_t start;     /* of the frame in the stream, before anything was lost */
    int32_t length;    /* bytes that the parser read for it */
    int32_t lost_at;   /* the first lost byte; -1: nothing was lost */
    int32_t lost;      /* bytes */
    int32_t as_mavlink1;
    int32_t spans;     /* whether the loss is inside it, or inside the rejected frame whose last byte it begins with */
} Accepted;

typedef struct {
    int64_t parses;
    int64_t accepted;
    int64_t spanning;
    int64_t losses;
    int64_t steps[STATES][STATES]; /* from one state of the parser to the next */
    int64_t framing[4];            /* results of the parser other than "incomplete" */
} Counts;

typedef struct {
    const uint8_t *data;
    int32_t length;
    const int32_t *frame_end; /* by offset: where the frame that was delivered there ends; 0: none begins */
    int32_t number;
    int options;
    Accepted *out;
    int32_t room;
    int32_t found;
    Counts *counts;
} Job;

static mavlink_message_t buffer;
static mavlink_status_t status;
#if VERSION == 2
static mavlink_signing_t signing;
static mavlink_signing_streams_t streams;

static bool takes_unsigned(const mavlink_status_t *of, uint32_t msgid)
{
    (void)of;
    return msgid == 109; /* RADIO_STATUS, as ArduPilot */
}

static bool takes_everything_unsigned(const mavlink_status_t *of, uint32_t msgid)
{
    (void)of;
    (void)msgid;
    return true;
}
#endif

static void reset(int options)
{
    mavlink_status_t *used = (options & RESUMES) || VERSION == 1 ? mavlink_get_channel_status(0) : &status;
    memset(used, 0, sizeof(*used));
#if VERSION == 2
    memset(&streams, 0, sizeof(streams));
    if (options & SIGNS) {
        memset(&signing, 0, sizeof(signing));
        signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
        for (int i = 0; i < 32; i++) {
            signing.secret_key[i] = (uint8_t)i;
        }
        signing.accept_unsigned_callback = options & TAKES_UNSIGNED ? takes_everything_unsigned : takes_unsigned;
        used->signing = &signing;
        used->signing_streams = &streams;
    }
#endif
}

static inline int step(Job *job, uint8_t byte)
{
    const int options = job->options;
    static mavlink_message_t message;
    static mavlink_status_t seen;
    mavlink_status_t *used = (options & RESUMES) || VERSION == 1 ? mavlink_get_channel_status(0) : &status;
    const unsigned before = used->parse_state;
    if ((options & NO_MAVLINK1) && byte == START1 && before <= MAVLINK_PARSE_STATE_IDLE) {
        return 0; /* a receiver for which 0xFE starts nothing */
    }
    int result;
    if (options & RESUMES) {
        result = mavlink_parse_char(0, byte, &message, &seen);
#if VERSION == 1
    } else {
        result = mavlink_frame_char(0, byte, &message, &seen);
#else
    } else {
        result = mavlink_frame_char_buffer(&buffer, &status, byte, &message, &seen);
#endif
    }
    job->counts->steps[before & 31][used->parse_state & 31]++;
    if (result) {
        job->counts->framing[result & 3]++;
    }
    return result == MAVLINK_FRAMING_OK;
}

static inline unsigned state(const Job *job)
{
    return ((job->options & RESUMES) || VERSION == 1 ? mavlink_get_channel_status(0) : &status)->parse_state;
}

static inline int is_mavlink1(const Job *job)
{
#if VERSION == 2
    const mavlink_status_t *used = (job->options & RESUMES) ? mavlink_get_channel_status(0) : &status;
    return (used->flags & MAVLINK_STATUS_FLAG_IN_MAVLINK1) != 0;
#else
    (void)job;
    return 1;
#endif
}

static void report(Job *job, int32_t start, int32_t origin, int32_t end, int32_t lost_at, int32_t lost)
{
    const int is_inside = lost_at >= 0 && start < lost_at && end > lost_at + lost;
    const int spans = lost_at >= 0 && origin < lost_at && end > lost_at + lost;
    job->counts->accepted++;
    job->counts->spanning += spans;
    if (!spans && job->frame_end[start] == end && (job->data[start] != 0xFD || !is_mavlink1(job))) {
        return; /* a frame as it was delivered */
    }
    if (job->found < job->room) {
        Accepted *to = &job->out[job->found];
        to->stream = job->number;
        to->start = start;
        to->length = end - start - (is_inside ? lost : 0);
        to->lost_at = lost_at;
        to->lost = lost;
        to->as_mavlink1 = is_mavlink1(job);
        to->spans = spans;
    }
    job->found++;
}

/* Parse from `from` on. With `once`, stop where the parser waits for a start byte again. */
static void parse(Job *job, int32_t from, int32_t lost_at, int32_t lost, bool once, int32_t start)
{
    int32_t origin = start;
    job->counts->parses++;
    for (int32_t i = from; i < job->length; i++) {
        if (i == lost_at) {
            i += lost;
            if (i >= job->length) {
                return;
            }
        }
        const bool was_idle = state(job) <= MAVLINK_PARSE_STATE_IDLE;
        if (step(job, job->data[i])) {
            report(job, start, origin, i + 1, lost_at, lost);
        }
        const unsigned now = state(job);
        if (now == MAVLINK_PARSE_STATE_GOT_STX) {
            if (was_idle || job->data[i] != 0xFD || !is_mavlink1(job)) {
                origin = i; /* otherwise it goes on in MAVLink 1, as the rejected frame made it */
            }
            start = i;
        } else if (once && now <= MAVLINK_PARSE_STATE_IDLE) {
            return;
        }
    }
}

static void from_every_offset(Job *job)
{
    for (int32_t i = 0; i < job->length; i++) {
        const uint8_t byte = job->data[i];
        if (byte == START1 || byte == 0xFD) {
            reset(job->options);
            parse(job, i, -1, 0, true, i);
        }
    }
}

static void with_losses(Job *job, uint64_t *seed, int32_t count)
{
    for (int32_t k = 0; k < count; k++) {
        *seed ^= *seed << 13;
        *seed ^= *seed >> 7;
        *seed ^= *seed << 17;
        const int32_t at = (int32_t)(*seed % (uint64_t)job->length);
        const int32_t lost = 1 + (int32_t)((*seed >> 32) % LONGEST_LOSS);
        reset(job->options);
        job->counts->losses++;
        parse(job, 0, at, lost, false, 0);
    }
}

static void with_every_loss(Job *job)
{
    for (int32_t at = 0; at < job->length; at++) {
        for (int32_t lost = 1; lost <= LONGEST_LOSS && at + lost < job->length; lost++) {
            reset(job->options);
            job->counts->losses++;
            parse(job, 0, at, lost, false, 0);
        }
    }
}

static void with_loss_of(Job *job, int32_t lost)
{
    for (int32_t at = 0; at + lost < job->length; at++) {
        reset(job->options);
        job->counts->losses++;
        parse(job, 0, at, lost, false, 0);
    }
}

/* Which frames beyond those delivered a receiver accepts in each stream; how many there were, as far as `room`.
 *
 * `begins`: count + 1 offsets of the streams in `data`. `losses`: random ones for each stream, or with -1 every one of
 * 1 to LONGEST_LOSS bytes at every offset, or with -1 - n every one of n bytes. `every_offset`: begin at each, too.
 */
int32_t judge(const uint8_t *data, const int32_t *begins, int32_t count, const int32_t *frame_end, int options,
              int every_offset, int32_t losses, uint64_t seed, Accepted *out, int32_t room, Counts *counts)
{
    Job job = {.options = options, .out = out, .room = room, .counts = counts};
    for (int32_t k = 0; k < count; k++) {
        job.data = data + begins[k];
        job.frame_end = frame_end + begins[k];
        job.length = begins[k + 1] - begins[k];
        job.number = k;
        if (job.length == 0) {
            continue;
        }
        reset(options);
        parse(&job, 0, -1, 0, false, 0);
        if (every_offset) {
            from_every_offset(&job);
        }
        if (losses > 0) {
            with_losses(&job, &seed, losses);
        } else if (losses == -1) {
            with_every_loss(&job);
        } else if (losses < -1) {
            with_loss_of(&job, -1 - losses);
        }
    }
    return job.found;
}
