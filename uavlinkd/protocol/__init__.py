"""The uavlink protocol, sans-IO: bytes, ``now`` and entropy come in; datagrams, frames and events go out.

Nothing in this package reaches a socket, a clock, a log or a random source, with one exception: ML-KEM's
encapsulation draws its randomness inside OpenSSL (``crypto.mlkem_encapsulate``). ``README.md`` beside this file is
the specification. This text explains how the parts drive each other.

The parts
---------
A :class:`.node.Node` has one identity and a :class:`.peer.Peer` for each other end. The shell calls the node with a
datagram (``receive``), with frames (``send``), or because time has passed (``handle_timeout``). Each call returns a
list of outputs (:mod:`.outputs`): the shell does them in order, and nothing is left in a queue here. A peer has:

========  =====================================================================  ======================
keys      ``sessions``: next, current, previous. ``initiator``: own handshakes   sessions, initiator
liveness  ``is_up``, when something was sent and received last, ``timers``         peer, timers, timeouts
paths     ``paths``: which ones there are, which is best, and the routes           paths, path_state
frames    in each session: what is new, and what is held until that is known      verification, freshness
========  =====================================================================  ======================

A session belongs to no path, and a path to no session: every path carries envelopes of every session.

Sessions
--------
No session is needed to add a peer. When keys are wanted (``Peer.keys_wanted_at``: there are none, they are old, or
the peer is silent), the timer INITIATE sends an initiation along every path that may lead to the peer. The
responder's answer makes a session that *waits*: its first valid envelope confirms it (``establish.adopt``).
Confirmed sessions have a rank that both ends compute alike. The highest one is *current*: it seals. The others only
receive until they expire. ``adopt`` is the hinge: it cancels other handshakes, starts the counts of every path from
zero, judges the paths and asks along each of them.

Paths
-----
A path is a socket and an address. It gets a slot from the configuration, or when an authentic envelope comes from an
unknown address. Only an answered question (a *probe*) proves it. ``PathState`` judges one path: unproven, usable,
suspect, down. ``PathSet.update`` judges all of them, elects the best one, and sets the *routes*: for each class of
frames the paths that carry it. Sending looks nothing up but its route. ``probing`` asks, answers, and calls
``PathSet.update`` after each answer; the timer PATHS does it when an answer is late. The best path also sets the
pace of everything that waits for an answer (``Peer.set_waits``, ``Session.set_pace``).

Freshness
---------
A tag shows who sealed an envelope, not when. So each end asks for an *echo* on the session in use while frames
arrive. The answer names the counters that are new. ``Verification`` knows until when frames are known to be new.
Without an answer until then, a frame waits in ``HeldFrames``, unless the ``screen`` of the policy lets it pass.
After a silence of 2 s every frame waits. The answer delivers what is new and drops the rest. An echo goes along the
paths as any envelope does: its answer also proves the only path, and measures the round trip.

Timers
------
Time acts through one table for each peer, ``TimerTable``: seven timers, each with one deadline and one handler in
:mod:`.timeouts`. A handler does what is due *now* and sets the next deadline. It may find nothing due: traffic moves
deadlines later without touching the table. Each part that waits says when by ``due_at``; the ``set_…`` methods of a
peer put the earliest of a group into the table. The node's ``Schedule`` orders the peers by their earliest deadline.

=========  ============================================  ==========================================================
timer      expires when                                  then
=========  ============================================  ==========================================================
EXPIRY     keys or an unanswered handshake are too old   they are forgotten; without a session the peer is lost
FRESHNESS  an echo or a held frame is late               ask again; drop what was held for too long
PATHS      an answer is late, or a question is due       ``PathSet.update``, and questions
SILENCE    something was sent, and nothing came          ask for an echo, then initiate, then give the peer up
INITIATE   keys are wanted                               initiate along every path, at growing intervals, indefinitely
PROBE      frames flow                                   measure the round trip
KEEPALIVE  no frames flow                                ask for an echo: a NAT forgets silent paths
=========  ============================================  ==========================================================

A frame that is sent starts SILENCE; an authentic envelope that is new stops it. So a dead link repairs itself in
stages: an echo after 0.5 s, an initiation after 1 s, *lost* after 3 s; paths are judged at the same time, and
faster.

What happens to a frame
-----------------------
Out: ``send_frames`` takes the current session and the route of the class, puts frames that are here together into
envelopes, and seals each once. The same bytes go along each path of the route, or along the part that the shell's
pacer chooses. ``send_again`` carries them along another path when that has room. A datagram is counted when it
leaves. A frame without a session is dropped and counted: it is never kept for later. Along an only path, all this is
decided once: the ``outlet`` stands until a path or the session changes.

In: ``DatagramReceiver.receive`` finds the session by its index, verifies the tag, and only then changes anything.
Whatever it refuses is a ``Drop`` with a reason, caught and counted in one place.

A frame whose path is lost while it waits: before it is sealed it has no path. It waits in the shell, at most
``max_age_s`` and until the peer is lost, and takes the route of the moment when it is sealed: that of the last best
path if all have failed; without a route it is dropped as ``no_session``. A sealed copy waits in the shell too, for
its own path, at most 0.5 s: another path carried the same bytes. A repeat leaves out paths that are down. A critical
frame while the last relayed path is gone is sealed and kept for 2 s (``Peer.recent``): the next relayed path carries
it (``send.resend``). A received frame that is held is tied to its session, not to its path. When the session ends, it
is dropped as ``doubtful``.

Where to add
------------
* A kind of record: its class and its branch of ``wire.parse_control``; a branch of ``receive._receive_control`` that
  says what an old one does; a feature bit if a peer may not know it; section 12. A record between a member and its
  relay, or another member, is in :mod:`.relay_records`, and arrives in the shell as ``RecordReceived``.
* A rule about which path carries what: ``PathSet._set_routes``.
* A rule about when a frame leaves: the shell, because a frame leaves as soon as the shell calls ``send``:
  ``Pacer`` and ``PeerEgress``, see the README of :mod:`uavlinkd.daemon`.
* A rule about when this end asks or tries: the handler of its timer, with its pace in ``PathSet.interval_s`` or
  ``Initiator.begin_try``.
* A reason to drop something: the table in :mod:`.drops`, and section 13.
"""
