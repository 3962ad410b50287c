/* An autopilot's end of a wire, made of MAVLink's C library: it judges, signs and answers as autopilots do.
 *
 * The library's parser and its check of signatures are called byte by byte. What is accepted without a signature is
 * the list of the caller.
 */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "mavlink.h"

enum { MOST_UNSIGNED = 8 };

typedef struct {
    mavlink_status_t status; /* first: the library passes its address to the callback */
    mavlink_message_t buffer;
    mavlink_signing_t signing;
    mavlink_signing_streams_t streams;
    uint32_t unsigned_ids[MOST_UNSIGNED];
    int32_t unsigned_count;
    bool takes_everything;
} Autopilot;

typedef struct {
    int32_t framing;   /* mavlink_framing_t */
    int32_t signature; /* mavlink_signing_status_t; 0: not checked */
    int32_t end;       /* offset behind the frame */
    uint32_t message;
} Verdict;

int32_t autopilot_bytes(void)
{
    return sizeof(Autopilot);
}

static bool takes_unsigned(const mavlink_status_t *status, uint32_t message)
{
    const Autopilot *autopilot = (const Autopilot *)status;
    for (int32_t i = 0; i < autopilot->unsigned_count; i++) {
        if (autopilot->unsigned_ids[i] == message) {
            return true;
        }
    }
    return autopilot->takes_everything;
}

void start(Autopilot *autopilot, const uint32_t *unsigned_ids, int32_t count)
{
    memset(autopilot, 0, sizeof(*autopilot));
    memcpy(autopilot->unsigned_ids, unsigned_ids, sizeof(*unsigned_ids) * (size_t)count);
    autopilot->unsigned_count = count;
}

/* The streams stay: ArduPilot's do when it gets a key. */
void use(Autopilot *autopilot, const uint8_t *key, uint64_t timestamp, int32_t link_id, bool takes_everything)
{
    autopilot->takes_everything = takes_everything;
    autopilot->status.signing = key == NULL ? NULL : &autopilot->signing;
    autopilot->status.signing_streams = key == NULL ? NULL : &autopilot->streams;
    if (key != NULL) {
        memcpy(autopilot->signing.secret_key, key, sizeof(autopilot->signing.secret_key));
        autopilot->signing.timestamp = timestamp;
        autopilot->signing.link_id = (uint8_t)link_id;
        autopilot->signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
        autopilot->signing.accept_unsigned_callback = takes_unsigned;
    }
}

uint64_t timestamp_of(const Autopilot *autopilot)
{
    return autopilot->signing.timestamp;
}

int32_t receive(Autopilot *autopilot, const uint8_t *data, int32_t length, Verdict *out, int32_t room)
{
    static mavlink_message_t message;
    static mavlink_status_t seen;
    int32_t count = 0;
    for (int32_t i = 0; i < length && count < room; i++) {
        autopilot->signing.last_status = MAVLINK_SIGNING_STATUS_NONE;
        const uint8_t framing =
            mavlink_frame_char_buffer(&autopilot->buffer, &autopilot->status, data[i], &message, &seen);
        if (framing != MAVLINK_FRAMING_INCOMPLETE) {
            const Verdict verdict = {framing, autopilot->signing.last_status, i + 1, message.msgid};
            out[count++] = verdict;
        }
    }
    return count;
}

int32_t send(Autopilot *autopilot, int32_t system, uint32_t message_id, const uint8_t *payload, int32_t length,
             int32_t crc_extra, uint8_t *out)
{
    static mavlink_message_t message;
    memset(&message, 0, sizeof(message));
    message.msgid = message_id;
    memcpy(_MAV_PAYLOAD_NON_CONST(&message), payload, (size_t)length);
    mavlink_finalize_message_buffer(&message, (uint8_t)system, MAV_COMP_ID_AUTOPILOT1, &autopilot->status,
                                    (uint8_t)length, (uint8_t)length, (uint8_t)crc_extra);
    return mavlink_msg_to_send_buffer(out, &message);
}
