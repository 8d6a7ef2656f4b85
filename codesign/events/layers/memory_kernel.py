"""The memory layer as one drjit loop over time per pixel, forward and adjoint, front end included;
two bits per step are stored between the two.

Forward, with L the log level, r the memorised level and C the threshold on the side of L - r: n =
floor(|L - r|/C), r += C n.

Backward is the play of width w = (C_on + C_off)/2 and centre m that the mean of n follows over
where in its threshold a pixel happens to stand (exactly for C_on = C_off, see docs/events.md;
``turns_adjoint`` is exact for all). It moves only where L leaves it, by as much as L does: n_on =
(L - m - w/2)/C_on, n_off = (m - w/2 - L)/C_off, and the edge then stands at L. So an engaged step
pulls at its own level, and pushes at the level of the step engaged before. Which edge moved when is
stored: the loop back in time takes no logarithm, and writes row by row.

The exact gradient of the mean count for unequal thresholds, as one drjit loop over time per pixel.

The mean runs over all places that a pixel may begin at: its memorised level r evenly over a box. A
small move of one level L_s makes the pixels that then stand on the brink fire at s, or not, and
moves nothing else. So with f the density on the brink (ON: r = L_s - C_on before, r = L_s after;
OFF: r = L_s + C_off before, L_s after)

    d mean(loss) / d L_s = f (J(fired) - J(not fired)),  J(r): what a pixel at r adds to the loss
    from s on,

for ON, and the negative for OFF: a **pair** of pixels, ``plus`` and ``minus``, C apart, simulated
from s on by the rule of the hard sensor. In the inside of a monotone stretch they meet in the very
next step; a pair born at a turn lives until they meet. For equal thresholds they meet when the way
back has reached C, and what is left is the play of ``play_adjoint``; unequal ones may never meet.

The pairs are also the edges of the density: of all pixels above ``plus`` and ``minus``, weight f
lies between. Whatever passes the brink in a step changes the density there, f = -sum of weight
(n_plus - n_minus) in signed counts n, and the box begins as a pair of its own. A pixel keeps
``PAIRS`` pairs beside the youngest. Where a turn needs more, the pair with the least weight x
distance is spread evenly over the threshold in use: mass is kept.
"""

from typing import Any

from codesign.events.kernels import Lanes, beyond
from codesign.exclusive import exclusive

WORD = 16  # steps, which fill a whole number with what moved the play at each
ROSE, FELL = 1, 2  # it: its upper edge, its lower one
PAIRS = 4
WIDTH = 6  # values of a pair
TIE = 1e-5  # thresholds: a pixel on the brink has not fired yet
MET = 1e-4  # thresholds: nearer pairs have met
# in place of a frame
START = 0xFFFFFFFE
NONE = 0xFFFFFFFF


class Loop(Lanes):
    """Frames, thresholds, and the loop over time. Without a start the first frame is where the rest
    begins."""

    def __init__(self, frames, start, theta_on, theta_off, front_end, packs=8):
        super().__init__(frames, frames[0].numel(), packs)
        self.theta_on, self.theta_off = (
            self.load_row(theta if theta.numel() == 1 else theta.expand(frames.shape[1:]))
            for theta in (theta_on, theta_off)
        )
        self.frames = frames
        # all of them: packs of what begins at an odd address take four times as long
        self.values = self.load(frames)
        self.begins = start is None
        self.steps = len(frames) - self.begins
        self.words = -(-self.steps // WORD)
        self.first, self.count = map(self.opaque, (self.begins, self.steps))
        # the first level comes by the arithmetic of the loop: a static scene then differs from it
        # by nothing
        self.begun = self.at(self.values, 0)
        level, self.begun_slope = front_end.traced(self.dr, self.begun)
        self.start = [level, level] if self.begins else self.rows(start)

    def __call__(self, step, carried, target, moves=None, back=False) -> Any:
        """Carry values through step(index, frame, word, *carried), the last frame first where it
        goes ``back``; ``target`` is what the steps write to. moves: rows of words of ``WORD``
        frames, which a way back reads and a way there fills."""
        loop = self.loop_back if back else self.loop

        def step_of(index, word, *carried):
            return step(index, self.at(self.values, index + self.first), word, *carried)

        def body(row, *carried):
            first = row * WORD
            end = self.dr.minimum(first + WORD, self.count)
            word = self.at(moves, row) if back else self.full(0, self.arr.UInt32)
            word, *carried = loop(first, end, step_of, word, *carried)
            if moves is not None and not back:
                self.put(moves, word, row)
            return carried

        with self.dr.suspend_grad():
            carried = loop(self.opaque(0), self.opaque(self.words), body, *carried)
            self.dr.eval(carried, target, moves)
        return carried

    def gradients(self, target, grad_start):
        """Gradients of the frames, and of the start where one was given. The mean count alone
        carries it: what reaches the memorised level reaches it through the place of the pixels that
        may be meant."""
        if self.begins:
            self.put(target, grad_start * self.begun_slope(), 0)
            self.dr.eval(target)
        grads = [self.full(0, self.arr.Float), grad_start]
        of_start = None if self.begins else self.stack(grads, self.frames.shape[1:])
        self.dr.sync_thread()
        return target.torch().reshape(self.frames.shape), of_start


@exclusive
def count(frames, start, theta_on, theta_off, front_end, *, keeps):
    """Counts [T, 2, ...] of frames [T, ...] from a start [2, ...] (memorised level, centre of the
    play), T - 1 from the first frame where it is None; the state after them; what moved the play,
    for ``play_adjoint``, where it ``keeps`` that, else None; whether a value may not enter."""
    loop = Loop(frames, start, theta_on, theta_off, front_end)
    dr = loop.dr
    arr = loop.arr
    target = loop.fresh(2 * loop.steps)
    moves = loop.fresh(loop.words, arr.UInt32) if keeps else None

    def step(index, value, word, bad, reference, centre):
        level = front_end.traced(dr, value)[0]
        difference = level - reference
        rose = difference > 0
        theta = dr.select(rose, loop.theta_on, loop.theta_off)
        total = exact_floor(dr, dr.abs(difference), theta)
        on = dr.select(rose, total, 0)
        off = dr.select(rose, 0, total)
        loop.put(target, on, 2 * index)
        loop.put(target, off, 2 * index + 1)
        rise, fall = beyond(dr, level, centre, loop.theta_on, loop.theta_off)
        word = dr.select(rise > 0, 4 * word + ROSE, 4 * word + dr.select(fall > 0, FELL, 0))
        bad = bad | ~front_end.accepts(dr, value)
        return word, bad, reference + (on - off) * theta, centre + (rise - fall)

    begun = (~front_end.accepts(dr, loop.begun), *loop.start)
    bad, *after = loop(step, begun, target, moves)
    bad = bool(dr.any(bad, axis=None)[0])
    pixels = frames.shape[1:]
    after = loop.stack(after, pixels)
    return target.torch().reshape(loop.steps, 2, *pixels), after, moves, bad


def exact_floor(dr, value, divisor):
    """floor(value/divisor) of the two floats as they are, for value >= 0: a rounded quotient may
    reach the next whole number too early."""
    whole = dr.floor(value / divisor)
    rest = dr.fma(-whole, divisor, value)
    return dr.select(rest < 0, whole - 1, dr.select(rest >= divisor, whole + 1, whole))


@exclusive
def play_adjoint(
    frames, start, theta_on, theta_off, front_end, grad_counts, grad_end, *, moves, wants_thetas
):
    """Adjoint of ``count``: gradients of the frames, start (None where it is), thresholds [2, ...]
    (None unless wanted).

    Args:
      grad_end: of the state.
      moves: of ``count``.
    """
    loop = Loop(frames, start, theta_on, theta_off, front_end)
    dr = loop.dr
    Float = loop.arr.Float
    seed = loop.load(grad_counts)
    target = loop.fresh(len(frames))
    half = (loop.theta_on + loop.theta_off) * 0.25

    def step(index, value, word, push, *of_thetas):
        rose, fell = ((word & one) != 0 for one in (ROSE, FELL))
        on, off = loop.at(seed, 2 * index), loop.at(seed, 2 * index + 1)
        # of this level through this step's count
        pull = dr.select(rose, on / loop.theta_on, -off / loop.theta_off)
        level, slope = front_end.traced(dr, value)
        grad = dr.select(rose | fell, (pull + push) * slope(), 0)
        loop.put(target, grad, index + loop.first)
        if wants_thetas:
            edge = dr.select(fell, loop.full(1, Float), 0)
            centre = level + dr.select(fell, half, -half)
            of_thetas = [
                dr.select(rose | fell, new, old)
                for new, old in zip(passed(push, edge, centre, *of_thetas), of_thetas, strict=True)
            ]
        return word >> 2, dr.select(rose | fell, -pull, push), *of_thetas

    def passed(push, edge, centre, later_edge, later_centre, grad_on, grad_off, grad_width):
        """Gradients to the thresholds, with those of the way from one edge of the play to the
        next."""
        gain = push * (later_centre - centre)
        return (
            edge,
            centre,
            grad_on + dr.select(later_edge == 0, gain / loop.theta_on, 0),
            grad_off + dr.select(later_edge == 1, gain / loop.theta_off, 0),
            # how the upper edge moves with the width: 0 where it stands at a level, 1 where the
            # lower one does, 1/2 at the start
            grad_width + push * (edge - later_edge),
        )

    # of the level of the step that moves the play next, through its count
    push = sum(loop.rows(grad_end))
    zero, middle = loop.full(0, Float), loop.full(0.5, Float)
    begun = [middle, zero, zero, zero, zero] if wants_thetas else []
    push, *of_thetas = loop(step, (push, *begun), target, moves, back=True)
    if wants_thetas:
        grad_on, grad_off, width = passed(push, middle, loop.start[1], *of_thetas)[2:]
        of_thetas = loop.stack([grad_on + width / 2, grad_off + width / 2], frames.shape[1:])
    return *loop.gradients(target, push), of_thetas


@exclusive
def turns_adjoint(frames, start, theta_on, theta_off, front_end, grad_counts, grad_end):
    """Gradients of the frames, and of the place of the box that the pixels begin in.

    Args, returns: as for ``play_adjoint``; the box lies from centre - theta_on/2 to centre +
      theta_off/2.
    """
    # pairs fill the registers
    loop = Loop(frames, start, theta_on, theta_off, front_end, packs=0)
    dr = loop.dr
    arr = loop.arr
    seed = loop.load(grad_counts)
    target = loop.zeros(len(frames))
    share = 2 / (loop.theta_on + loop.theta_off)  # of a pixel per level, in the box

    def emit(frame, grad, grad_start):
        loop.put(target, grad * share, frame + loop.first, frame < START)
        return dr.select(frame == START, grad * share, grad_start)

    def step(index, value, word, grad_start, before, *slots):
        level, slope = front_end.traced(dr, value)
        pairs = _Pairs(loop, level, before, slots)
        pairs.walk(loop.at(seed, 2 * index + dr.select(pairs.rises, loop.arr.UInt32(0), 1)))
        grad_start = emit(*pairs.renew(index, slope()), grad_start)
        return word, grad_start, level, *pairs.joined()

    reference, centre = loop.start
    zero = dr.zeros(arr.Float, loop.width)
    none = dr.full(arr.UInt32, NONE, loop.width)
    box = (centre + loop.theta_off / 2, centre - loop.theta_on / 2, zero + 1, zero, zero + 1)
    empty = (zero, zero, zero, zero, zero, none)
    begun = (zero, reference, *box, none - 1, *empty * PAIRS)
    grad_start, _, *slots = loop(step, begun, target)
    end = sum(loop.rows(grad_end))
    for k in range(0, len(slots), WIDTH):
        plus, minus, weight, grad, slope, frame = slots[k : k + WIDTH]
        grad_start = emit(frame, (grad + end * weight * (plus - minus)) * slope, grad_start)
    return loop.gradients(target, grad_start)


class _Pairs:
    """The pairs of one step, the youngest first. Each is six values: plus, minus, weight, gradient,
    slope of the front end at the frame that it belongs to, and that frame."""

    def __init__(self, loop, level, before, slots):
        dr = loop.dr
        self.dr = dr
        self.level = level
        self.slots = [list(slots[k : k + WIDTH]) for k in range(0, len(slots), WIDTH)]
        self.rises = level > before
        self.theta = dr.select(self.rises, loop.theta_on, loop.theta_off)
        self.direction = dr.select(self.rises, dr.full(loop.arr.Float, 1), -1)

    def walk(self, seed):
        """Every pixel fires by the rule of the sensor; each event adds ``seed``."""
        dr = self.dr
        jump = self.theta * self.direction
        per_theta = dr.rcp(jump)
        passed = []
        self.seed = seed
        for slot in self.slots:
            plus, minus, weight = slot[:3]
            by_plus, by_minus = (
                dr.maximum(dr.floor(dr.fma(self.level - place, per_theta, -TIE)), 0)
                for place in (plus, minus)
            )
            more = weight * (by_plus - by_minus)
            passed.append(more)
            slot[0] = dr.fma(by_plus, jump, plus)
            slot[1] = dr.fma(by_minus, jump, minus)
            slot[2] = dr.select(dr.abs(slot[0] - slot[1]) < MET * self.theta, 0, weight)
            slot[3] = dr.fma(more, seed, slot[3])
        self.flux = -self.direction * _sum(passed)

    def renew(self, frame, slope):
        """A new youngest pair where something fired; the one before is kept where its pixels have
        not met. Returns the frame whose gradient is complete (NONE where there is none), and the
        gradient."""
        dr = self.dr
        fired = dr.abs(self.flux) > TIE
        keeps = fired & (self.slots[0][2] != 0)
        least = self.slots[1]
        least_size = _size(dr, least)
        chosen = 1
        for k, slot in enumerate(self.slots[2:], 2):
            smaller = _size(dr, slot) < least_size
            least_size = dr.select(smaller, _size(dr, slot), least_size)
            least = [dr.select(smaller, a, b) for a, b in zip(slot, least, strict=True)]
            chosen = dr.select(smaller, k, chosen)
        spread = least[2] * (least[0] - least[1]) / self.theta
        flux = self.flux + dr.select(keeps, spread, 0)
        youngest = self.slots[0]
        for k, slot in enumerate(self.slots[1:], 1):
            here = keeps & (chosen == k)
            slot[:] = [dr.select(here, a, b) for a, b in zip(youngest, slot, strict=True)]
        upper = dr.select(self.rises, self.level, self.level + self.theta)
        new = [
            upper,
            upper - self.theta,
            flux,
            self.flux * self.direction * self.seed,
            slope,
            frame,
        ]
        grad, slope, frame = (
            dr.select(keeps, a, b) for a, b in zip(least[3:], youngest[3:], strict=True)
        )
        self.slots[0] = [dr.select(fired, a, b) for a, b in zip(new, youngest, strict=True)]
        return dr.select(fired, frame, NONE), grad * slope

    def joined(self):
        return [value for slot in self.slots for value in slot]


def _sum(values):
    """Sum by halves, which a processor adds side by side."""
    half = len(values) // 2
    return _sum(values[:half]) + _sum(values[half:]) if half else values[0]


def _size(dr, slot):
    return dr.abs(slot[2] * (slot[0] - slot[1]))
