-- Wireshark dissector of the uavlink protocol, version 2. README.md beside this file says how to use it.
--
-- It needs no key. The handshake encrypts tag length and mode, so the dissector infers them: in authenticated mode the
-- payload is readable, and the tag is what follows the last whole frame or record. It runs on Lua 5.2 and 5.4.

local uavlink = Proto("uavlink", "uavlink")

-- Suites: number, name, bytes of the initiator's share, bytes of the responder's ciphertext.
local SUITES = {
    [0] = { "x25519", 0, 0 },
    [1] = { "ffdhe2048", 256, 256 },
    [2] = { "ffdhe3072", 384, 384 },
    [3] = { "ffdhe4096", 512, 512 },
    [4] = { "ffdhe6144", 768, 768 },
    [5] = { "ffdhe8192", 1024, 1024 },
    [16] = { "mlkem768", 1184, 1088 },
    [17] = { "mlkem1024", 1568, 1568 },
}
local SUITE_NAMES = {}
for number, suite in pairs(SUITES) do
    SUITE_NAMES[number] = suite[1]
end

local INITIATION, RESPONSE, COOKIE, SHORT_ENVELOPE, LONG_ENVELOPE = 1, 2, 3, 0x40, 0x41
local TYPES = {
    [INITIATION] = "Handshake Initiation",
    [RESPONSE] = "Handshake Response",
    [COOKIE] = "Cookie Reply",
    [SHORT_ENVELOPE] = "Envelope, 2-byte counter",
    [LONG_ENVELOPE] = "Envelope, 4-byte counter",
}
local AEAD_TAG_BYTES, COOKIE_BYTES, CERTIFICATE_BYTES = 16, 52, 100
local TAG_LENGTHS = { 16, 8, 12 } -- 16 is the default, so it comes first
local IS_TAG_LENGTH = { [8] = true, [12] = true, [16] = true }

-- Control records: first byte of the payload, name, bytes. Payloads of frames start at 0xF0 or above.
local RECORDS = {
    [1] = { "Echo Request", 13 },
    [2] = { "Echo Reply", 17 },
    [3] = { "Probe" }, -- 22 bytes with a question, else 20; frames or padding may follow
    [5] = { "Close", 1 },
    [6] = { "Refusal Report" }, -- 1 byte, and 10 for each of 1 to 16 entries
    [7] = { "Encrypted Record" }, -- 1 byte, a record of at least 1 byte, and its AEAD tag
    [8] = { "Problem Report" }, -- 1 byte, and 1 for each of 0 to 8 codes
}
local REFUSAL_REPORT, ENTRY_BYTES, MOST_ENTRIES = 6, 10, 16
local ENCRYPTED_RECORD = 7
local PROBLEM_REPORT, MOST_CODES = 8, 8
local PROBE, ANSWER_BYTES, QUESTION_BYTES = 3, 20, 22
local ALONE, FRAMES_FOLLOW, PADDING_FOLLOWS = 0, 1, 2
local PROBE_FLAGS = { [ALONE] = "alone", [FRAMES_FOLLOW] = "frames follow", [PADDING_FOLLOWS] = "padding follows" }
local REASONS = {
    [1] = "foreign_system",
    [2] = "message_not_allowed",
    [3] = "unknown_message",
    [4] = "command_not_allowed",
    [5] = "file_write_not_allowed",
    [6] = "setup_signing",
    [7] = "mavlink1_not_allowed",
    [8] = "ground_station_not_allowed",
    [9] = "rate_limited",
    [10] = "hidden_frame",
}
local RECORD_NAMES = {}
for number, record in pairs(RECORDS) do
    RECORD_NAMES[number] = record[1]
end
local FRAMES_FROM = 0xF0
local SHORT_COUNTER_LIMIT = 65536

local f = {
    type = ProtoField.uint8("uavlink.type", "Type", base.HEX, TYPES),
    suite = ProtoField.uint8("uavlink.suite", "Suite", base.DEC, SUITE_NAMES),
    sender = ProtoField.uint16("uavlink.sender_index", "Sender index", base.HEX),
    receiver = ProtoField.uint16("uavlink.receiver_index", "Receiver index", base.HEX),
    ephemeral = ProtoField.bytes("uavlink.ephemeral", "Ephemeral X25519 public key"),
    group = ProtoField.bytes("uavlink.sealed_group", "Encrypted share of the suite's group"),
    static = ProtoField.bytes("uavlink.sealed_static", "Encrypted static public key"),
    parameters = ProtoField.bytes("uavlink.sealed_payload", "Encrypted parameters, and certificate in the long form"),
    mac1 = ProtoField.bytes("uavlink.mac1", "mac1"),
    mac2 = ProtoField.bytes("uavlink.mac2", "mac2"),
    nonce = ProtoField.bytes("uavlink.cookie_nonce", "Nonce"),
    cookie = ProtoField.bytes("uavlink.sealed_cookie", "Encrypted cookie"),
    counter = ProtoField.uint32("uavlink.counter", "Counter", base.DEC),
    mode = ProtoField.string("uavlink.mode", "Mode"),
    payload = ProtoField.bytes("uavlink.payload", "Payload"),
    tag = ProtoField.bytes("uavlink.tag", "Tag"),
    tag_bytes = ProtoField.uint8("uavlink.tag_bytes", "Tag length", base.DEC),
    tag_inferred = ProtoField.bool("uavlink.tag_inferred", "Tag length is inferred"),
    record = ProtoField.uint8("uavlink.record", "Control record", base.DEC, RECORD_NAMES),
    token = ProtoField.bytes("uavlink.token", "Token"),
    received = ProtoField.uint32("uavlink.received", "Envelopes received", base.DEC),
    expected = ProtoField.uint32("uavlink.expected", "Envelopes expected", base.DEC),
    fresh = ProtoField.uint32("uavlink.fresh", "Fresh from counter", base.DEC),
    probe_flags = ProtoField.uint8("uavlink.probe.flags", "Flags", base.DEC, PROBE_FLAGS),
    probe_question = ProtoField.uint32("uavlink.probe.question", "Question (0: none)", base.HEX),
    probe_answer = ProtoField.uint32("uavlink.probe.answer", "Answer to question (0: none)", base.HEX),
    probe_sent = ProtoField.uint32("uavlink.probe.sent", "Datagrams sent along this path", base.DEC),
    probe_received = ProtoField.uint32("uavlink.probe.received", "Datagrams received along this path", base.DEC),
    probe_padding = ProtoField.bytes("uavlink.probe.padding", "Padding"),
    refused_msgid = ProtoField.uint24("uavlink.refused.msgid", "Refused message id", base.DEC),
    refused_command = ProtoField.uint16("uavlink.refused.command", "Refused command (0: none)", base.DEC),
    refused_reason = ProtoField.uint8("uavlink.refused.reason", "Reason", base.DEC, REASONS),
    refused_total = ProtoField.uint32("uavlink.refused.total", "Refused so far", base.DEC),
    frame = ProtoField.bytes("uavlink.frame", "MAVLink frame"),
    version = ProtoField.uint8("uavlink.frame.version", "MAVLink version", base.DEC),
    sequence = ProtoField.uint8("uavlink.frame.sequence", "Sequence", base.DEC),
    system = ProtoField.uint8("uavlink.frame.system", "System", base.DEC),
    component = ProtoField.uint8("uavlink.frame.component", "Component", base.DEC),
    msgid = ProtoField.uint32("uavlink.frame.msgid", "Message id", base.DEC),
    signed = ProtoField.bool("uavlink.frame.signed", "Signed by MAVLink"),
}
local fields = {}
for _, field in pairs(f) do
    fields[#fields + 1] = field
end
uavlink.fields = fields

local malformed = ProtoExpert.new("uavlink.malformed", "Malformed uavlink message", expert.group.MALFORMED, expert.severity.ERROR)
local unreadable =
    ProtoExpert.new("uavlink.unreadable", "No frame is readable: confidential mode, or not an envelope", expert.group.UNDECODED, expert.severity.NOTE)
uavlink.experts = { malformed, unreadable }

local INFER, CONFIDENTIAL = 0, 1
uavlink.prefs.port = Pref.uint("UDP port", 5790, "Port of the daemons. Others are recognised by their handshake.")
uavlink.prefs.tag = Pref.enum("Tag length", INFER, "Tag length of envelopes, or confidential mode, if the dissector infers it wrongly.", {
    { 1, "infer", INFER },
    { 2, "8 bytes", 8 },
    { 3, "12 bytes", 12 },
    { 4, "16 bytes", 16 },
    { 5, "confidential", CONFIDENTIAL },
}, false)

-- The length of the frame at `offset`, or nil if no whole frame begins there.
local function frame_length(tvb, offset)
    local left = tvb:len() - offset
    if left < 8 then
        return nil
    end
    local start, length = tvb(offset, 1):uint(), tvb(offset + 1, 1):uint()
    if start == 0xFE then
        length = length + 8
    elseif start == 0xFD then
        length = length + 12
        if tvb(offset + 2, 1):uint() % 2 == 1 then -- MAVLINK_IFLAG_SIGNED
            length = length + 13
        end
    else
        return nil
    end
    return length <= left and length or nil
end

-- The length of the probe at `offset`, without what follows it, or nil if it is not a valid one.
local function probe_length(tvb, offset)
    local left = tvb:len() - offset
    if left < ANSWER_BYTES or not PROBE_FLAGS[tvb(offset + 1, 1):uint()] then
        return nil
    end
    if tvb(offset + 2, 4):uint() == 0 then
        return tvb(offset + 6, 4):uint() ~= 0 and ANSWER_BYTES or nil
    end
    return left >= QUESTION_BYTES and tvb(offset + ANSWER_BYTES, 2):uint() == 0 and QUESTION_BYTES or nil
end

-- Whether a control record of this kind, which is not a probe, can have this length.
local function is_record(kind, size)
    if kind == REFUSAL_REPORT then
        return (size - 1) % ENTRY_BYTES == 0 and size > 1 and size <= 1 + MOST_ENTRIES * ENTRY_BYTES
    end
    if kind == ENCRYPTED_RECORD then
        return size > 1 + AEAD_TAG_BYTES
    end
    if kind == PROBLEM_REPORT then
        return size >= 1 and size <= 1 + MOST_CODES
    end
    return RECORDS[kind] ~= nil and RECORDS[kind][2] == size
end

-- Adds the tag lengths that may follow whole frames from `offset`.
local function add_tags_after_frames(tvb, offset, found)
    local length = frame_length(tvb, offset)
    while length do
        offset = offset + length
        if IS_TAG_LENGTH[tvb:len() - offset] then
            found[tvb:len() - offset] = true
        end
        length = frame_length(tvb, offset)
    end
end

-- Adds the tag lengths that may follow a probe and what is behind it.
local function add_tags_after_probe(tvb, offset, found)
    local length = probe_length(tvb, offset)
    if not length then
        return
    end
    local flags, left = tvb(offset + 1, 1):uint(), tvb:len() - offset - length
    if flags == FRAMES_FOLLOW then
        add_tags_after_frames(tvb, offset + length, found)
    end
    for _, tag_bytes in ipairs(TAG_LENGTHS) do
        if (flags == ALONE and left == tag_bytes) or (flags == PADDING_FOLLOWS and left > tag_bytes) then
            found[tag_bytes] = true
        end
    end
end

-- The tag lengths with which the bytes from `offset` are a keepalive, a record, or whole frames: {16 = true, …}.
local function possible_tags(tvb, offset)
    local found, size = {}, tvb:len() - offset
    if IS_TAG_LENGTH[size] then
        found[size] = true
    end
    if size == 0 then
        return found
    end
    local kind = tvb(offset, 1):uint()
    if kind == PROBE then
        add_tags_after_probe(tvb, offset, found)
    elseif RECORDS[kind] then
        for _, tag_bytes in ipairs(TAG_LENGTHS) do
            if is_record(kind, size - tag_bytes) then
                found[tag_bytes] = true
            end
        end
    else
        add_tags_after_frames(tvb, offset, found)
    end
    return found
end

-- What earlier envelopes of the same receiver and index allow: address, port and index -> tag lengths.
local sessions = {}

function uavlink.init()
    sessions = {}
end

-- The tag length of this envelope, or nil if none fits, as in confidential mode.
local function infer_tag(tvb, pinfo, offset, index)
    local key = tostring(pinfo.dst) .. " " .. pinfo.dst_port .. " " .. index
    local here
    if tvb:len() > offset and tvb(offset, 1):uint() == ENCRYPTED_RECORD then
        here = sessions[key] or {} -- nothing inside shows its end, and an encrypted payload may begin with any byte
    else
        here = possible_tags(tvb, offset)
    end
    local common, is_empty = {}, true
    for length in pairs(sessions[key] or here) do
        if here[length] then
            common[length], is_empty = true, false
        end
    end
    if is_empty then
        common = here
    elseif not pinfo.visited and not IS_TAG_LENGTH[tvb:len() - offset] then -- a keepalive is the same in both modes
        sessions[key] = common
    end
    for _, length in ipairs(TAG_LENGTHS) do
        if common[length] then
            return length
        end
    end
    return nil
end

local function add_frame(tvb, tree, offset, length)
    local branch = tree:add(f.frame, tvb(offset, length))
    local is_v2 = tvb(offset, 1):uint() == 0xFD
    local at = offset + (is_v2 and 4 or 2)
    branch:add(f.version, tvb(offset, 1), is_v2 and 2 or 1)
    branch:add(f.sequence, tvb(at, 1))
    branch:add(f.system, tvb(at + 1, 1))
    branch:add(f.component, tvb(at + 2, 1))
    if is_v2 then
        branch:add_le(f.msgid, tvb(at + 3, 3))
        branch:add(f.signed, tvb(offset + 2, 1), tvb(offset + 2, 1):uint() % 2 == 1)
    else
        branch:add(f.msgid, tvb(at + 3, 1))
    end
end

-- The dissector that pymavlink generates, if it is loaded.
local function mavlink_dissector()
    local is_found, dissector = pcall(Dissector.get, "mavlink_proto")
    return is_found and dissector or nil
end

local function add_frames(tvb, pinfo, tree, offset, stop)
    local count, first = 0, offset
    local length = frame_length(tvb, offset)
    while length and offset + length <= stop do
        add_frame(tvb, tree, offset, length)
        count, offset = count + 1, offset + length
        length = frame_length(tvb, offset)
    end
    local mavlink = mavlink_dissector()
    if mavlink and offset > first then
        local info = tostring(pinfo.cols.info)
        pcall(mavlink.call, mavlink, tvb(first, offset - first):tvb(), pinfo, tree)
        pinfo.cols.protocol = "uavlink"
        pinfo.cols.info = info
    end
    return count
end

local function add_record(tvb, tree, offset, kind, stop)
    tree:add(f.record, tvb(offset, 1))
    if kind == 1 or kind == 2 then
        tree:add(f.token, tvb(offset + 1, 4))
        tree:add(f.received, tvb(offset + 5, 4))
        tree:add(f.expected, tvb(offset + 9, 4))
        if kind == 2 then
            tree:add(f.fresh, tvb(offset + 13, 4))
        end
    elseif kind == ENCRYPTED_RECORD then
        tree:add(f.payload, tvb(offset + 1, stop - offset - 1)):append_text(" (encrypted)")
    elseif kind == REFUSAL_REPORT then
        for at = offset + 1, stop - ENTRY_BYTES, ENTRY_BYTES do
            tree:add(f.refused_msgid, tvb(at, 3))
            tree:add(f.refused_command, tvb(at + 3, 2))
            tree:add(f.refused_reason, tvb(at + 5, 1))
            tree:add(f.refused_total, tvb(at + 6, 4))
        end
    end
end

local function count_text(count)
    return count == 1 and "1 frame" or count .. " frames"
end

-- Adds a probe and what follows it, and returns what it is in a few words; nil if it is not a valid one.
local function add_probe(tvb, pinfo, tree, offset, stop)
    local length = probe_length(tvb, offset)
    local flags = length and tvb(offset + 1, 1):uint()
    local after = length and offset + length
    if not length or after > stop or (flags == ALONE) ~= (after == stop) then
        return nil
    end
    tree:add(f.record, tvb(offset, 1))
    tree:add(f.probe_flags, tvb(offset + 1, 1))
    tree:add(f.probe_question, tvb(offset + 2, 4))
    tree:add(f.probe_answer, tvb(offset + 6, 4))
    tree:add(f.probe_sent, tvb(offset + 10, 4))
    tree:add(f.probe_received, tvb(offset + 14, 4))
    local text = length == ANSWER_BYTES and "Probe, answer"
        or tvb(offset + 6, 4):uint() ~= 0 and "Probe, answer and question"
        or "Probe, question"
    if flags == FRAMES_FOLLOW then
        text = text .. ", " .. count_text(add_frames(tvb, pinfo, tree, after, stop))
    elseif flags == PADDING_FOLLOWS then
        tree:add(f.probe_padding, tvb(after, stop - after))
    end
    return text
end

-- Adds the payload, and returns what it is in a few words.
local function add_payload(tvb, pinfo, tree, offset, stop)
    if stop == offset then
        return "keepalive"
    end
    local kind = tvb(offset, 1):uint()
    local probe = kind == PROBE and add_probe(tvb, pinfo, tree, offset, stop)
    if probe then
        return probe
    elseif is_record(kind, stop - offset) then
        add_record(tvb, tree, offset, kind, stop)
        return RECORDS[kind][1]
    end
    if kind >= FRAMES_FROM then
        return count_text(add_frames(tvb, pinfo, tree, offset, stop))
    end
    tree:add(f.payload, tvb(offset, stop - offset))
    tree:add_proto_expert_info(malformed)
    return "unknown record"
end

local function dissect_envelope(tvb, pinfo, tree)
    local header = tvb(0, 1):uint() == SHORT_ENVELOPE and 5 or 7
    if tvb:len() < header + 8 then
        tree:add_proto_expert_info(malformed)
        return "Envelope, too short"
    end
    local index, counter = tvb(1, 2):uint(), tvb(3, header - 3):uint()
    tree:add(f.receiver, tvb(1, 2))
    tree:add(f.counter, tvb(3, header - 3))
    if index == 0 or (header == 7 and counter < SHORT_COUNTER_LIMIT) then
        tree:add_proto_expert_info(malformed)
    end

    local chosen = uavlink.prefs.tag
    local tag_bytes, is_inferred
    if chosen == INFER then
        tag_bytes, is_inferred = infer_tag(tvb, pinfo, header, index), true
    elseif chosen == CONFIDENTIAL then
        tag_bytes, is_inferred = nil, false
    else
        tag_bytes, is_inferred = chosen, false
    end

    local summary
    if tag_bytes and tvb:len() >= header + tag_bytes then
        local stop = tvb:len() - tag_bytes
        tree:add(f.mode, is_inferred and "authenticated (inferred)" or "authenticated"):set_generated()
        summary = add_payload(tvb, pinfo, tree, header, stop)
        tree:add(f.tag, tvb(stop, tag_bytes))
    else
        local stop = tvb:len() - AEAD_TAG_BYTES
        tree:add(f.mode, is_inferred and "confidential (inferred)" or "confidential"):set_generated()
        if stop > header then
            tree:add(f.payload, tvb(header, stop - header)):append_text(" (encrypted)")
        end
        if stop >= header then
            tree:add(f.tag, tvb(stop, AEAD_TAG_BYTES))
            tag_bytes = AEAD_TAG_BYTES
        end
        if is_inferred then
            tree:add_proto_expert_info(unreadable)
        end
        summary = "unreadable"
    end
    if tag_bytes then
        tree:add(f.tag_bytes, tag_bytes):set_generated()
    end
    tree:add(f.tag_inferred, is_inferred):set_generated()
    return string.format("Envelope to 0x%04x, counter %d: %s", index, counter, summary)
end

-- Adds fields of given sizes in order; a size of 0 leaves the field out.
local function add_in_order(tvb, tree, offset, sizes)
    for _, entry in ipairs(sizes) do
        if entry[2] > 0 then
            local item = tree:add(entry[1], tvb(offset, entry[2]))
            if entry[1] == f.mac2 and tvb(offset, 16):bytes():tohex():match("^0+$") then
                item:append_text(" (no cookie)")
            end
            offset = offset + entry[2]
        end
    end
end

-- The length that a handshake message must have, or nil if it is not one.
local function handshake_length(tvb)
    if tvb:len() < 6 then
        return nil
    end
    local kind, suite = tvb(0, 1):uint(), SUITES[tvb(1, 1):uint()]
    if kind == INITIATION and suite and tvb(2, 2):uint() > 0 then
        local short = 147 + (suite[2] > 0 and suite[2] + AEAD_TAG_BYTES or 0)
        return tvb:len() == short + CERTIFICATE_BYTES and tvb:len() or short
    elseif kind == RESPONSE and suite and tvb(2, 2):uint() > 0 and tvb(4, 2):uint() > 0 then
        return 103 + (suite[3] > 0 and suite[3] + AEAD_TAG_BYTES or 0)
    elseif kind == COOKIE and tvb(1, 1):uint() == 0 and tvb(2, 2):uint() > 0 then
        return COOKIE_BYTES
    end
    return nil
end

local function dissect_handshake(tvb, tree)
    local kind = tvb(0, 1):uint()
    if handshake_length(tvb) ~= tvb:len() then
        tree:add_proto_expert_info(malformed)
        return TYPES[kind] .. ", of a wrong length or suite"
    end
    if kind == COOKIE then
        tree:add(f.receiver, tvb(2, 2))
        tree:add(f.nonce, tvb(4, 16))
        tree:add(f.cookie, tvb(20, 32))
        return string.format("%s to 0x%04x", TYPES[kind], tvb(2, 2):uint())
    end
    local suite = SUITES[tvb(1, 1):uint()]
    tree:add(f.suite, tvb(1, 1))
    tree:add(f.sender, tvb(2, 2))
    if kind == INITIATION then
        local share = suite[2] > 0 and suite[2] + AEAD_TAG_BYTES or 0
        local payload = tvb:len() - 116 - share
        add_in_order(tvb, tree, 4, { { f.ephemeral, 32 }, { f.group, share }, { f.static, 48 }, { f.parameters, payload }, { f.mac1, 16 }, { f.mac2, 16 } })
        local form = payload > 31 and ", with a certificate" or ""
        return string.format("%s, %s, sender 0x%04x%s", TYPES[kind], suite[1], tvb(2, 2):uint(), form)
    end
    local ciphertext = suite[3] > 0 and suite[3] + AEAD_TAG_BYTES or 0
    tree:add(f.receiver, tvb(4, 2))
    add_in_order(tvb, tree, 6, { { f.ephemeral, 32 }, { f.group, ciphertext }, { f.parameters, 33 }, { f.mac1, 16 }, { f.mac2, 16 } })
    return string.format("%s, %s, sender 0x%04x to 0x%04x", TYPES[kind], suite[1], tvb(2, 2):uint(), tvb(4, 2):uint())
end

function uavlink.dissector(tvb, pinfo, tree)
    local kind = tvb:len() > 0 and tvb(0, 1):uint() or -1
    if not TYPES[kind] then
        return 0
    end
    pinfo.cols.protocol = "uavlink"
    local branch = tree:add(uavlink, tvb())
    branch:add(f.type, tvb(0, 1))
    local summary
    if kind == SHORT_ENVELOPE or kind == LONG_ENVELOPE then
        summary = dissect_envelope(tvb, pinfo, branch)
    else
        summary = dissect_handshake(tvb, branch)
    end
    branch:append_text(": " .. summary)
    pinfo.cols.info = summary
    return tvb:len()
end

-- On other ports, a handshake message of exactly its length shows the protocol; the conversation's envelopes follow.
local function recognise(tvb, pinfo, tree)
    if handshake_length(tvb) ~= tvb:len() then
        return false
    end
    pinfo.conversation = uavlink
    uavlink.dissector(tvb, pinfo, tree)
    return true
end

uavlink:register_heuristic("udp", recognise)

local udp_table, used_port = DissectorTable.get("udp.port"), 0

local function use_port()
    if used_port ~= uavlink.prefs.port then
        if used_port > 0 then
            udp_table:remove(used_port, uavlink)
        end
        used_port = uavlink.prefs.port
        if used_port > 0 then
            udp_table:add(used_port, uavlink)
        end
    end
end

function uavlink.prefs_changed()
    use_port()
end

use_port()
