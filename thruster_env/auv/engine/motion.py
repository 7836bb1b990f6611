"""How a block of vehicles moves in one sample time: commands, lags, equations of motion.

The equations are those of `dynamics`; here they meet the memory. Everything works on `memory[b]`, see
`thruster_env.auv.engine.memory`.
"""

from __future__ import annotations

from thruster_env.auv.dynamics import current_substep
from thruster_env.auv.engine.memory import (
    COMMAND,
    CONSTANT_COUNT,
    CURRENT,
    INPUT_COUNT,
    INPUTS,
    MAX_PLANE,
    MAX_THRUST,
    MAX_TORQUE,
    MEAN,
    PLANE_DECAY,
    PROPELLER_DECAY,
    STATE,
    SUBSTEPS,
    TORQUE_RATIO,
    N,
)
from thruster_env.auv.forces import Constants
from thruster_env.core.compiled import inlined
from thruster_env.core.tuples import tuple_of, written_out

read_constants = written_out(
    "constants",
    "numbers",
    f"Constants({', '.join(f'numbers[{i}]' for i in range(CONSTANT_COUNT))})",
    Constants=Constants,
)
read_state = written_out("state", "memory, b, j", tuple_of(f"memory[b, {STATE + i}, j]" for i in range(N)))
write_state = written_out(
    "store", "memory, b, j, x", *(f"memory[b, {STATE + i}, j] = x[{i}]" for i in range(N)), "None"
)
read_inputs = written_out(
    "inputs",
    "memory, b, j",
    tuple_of(f"memory[b, {row}, j]" for row in (*range(INPUTS, INPUTS + 4), *range(CURRENT, CURRENT + 3))),
)


@inlined
def begin_at_mean(memory, b, numbers):
    """Put every copy at the mean of the initial state, with nothing commanded."""
    for i in range(N):
        for j in range(memory.shape[2]):
            memory[b, STATE + i, j] = numbers[MEAN + i]
    for i in range(4):
        for j in range(memory.shape[2]):
            memory[b, COMMAND + i, j] = 0.0
            memory[b, INPUTS + i, j] = 0.0


@inlined
def limited(value, limit):
    """Value within plus and minus a limit."""
    return min(max(value, -limit), limit)


@inlined
def take_commands(memory, b, numbers):
    """Clip the commands to the action space, and let the propeller and the planes follow them."""
    top, torque, plane, ratio = numbers[MAX_THRUST], numbers[MAX_TORQUE], numbers[MAX_PLANE], numbers[TORQUE_RATIO]
    of_propeller, of_planes = numbers[PROPELLER_DECAY], numbers[PLANE_DECAY]
    told = numbers[INPUT_COUNT] > 3.0  # of the torque
    stern = COMMAND + (2 if told else 1)
    for j in range(memory.shape[2]):
        thrust = min(max(memory[b, COMMAND, j], 0.0), top)
        turning = limited(memory[b, COMMAND + 1, j], torque) if told else ratio * thrust
        stern_plane, rudder = limited(memory[b, stern, j], plane), limited(memory[b, stern + 1, j], plane)
        memory[b, INPUTS, j] = thrust + of_propeller * (memory[b, INPUTS, j] - thrust)
        memory[b, INPUTS + 1, j] = turning + of_propeller * (memory[b, INPUTS + 1, j] - turning)
        memory[b, INPUTS + 2, j] = stern_plane + of_planes * (memory[b, INPUTS + 2, j] - stern_plane)
        memory[b, INPUTS + 3, j] = rudder + of_planes * (memory[b, INPUTS + 3, j] - rudder)
        memory[b, COMMAND, j], memory[b, stern, j], memory[b, stern + 1, j] = thrust, stern_plane, rudder


@inlined
def move(memory, b, numbers):
    """Integrate the equations of motion over one sample time, in the current."""
    c = read_constants(numbers)
    for _ in range(int(numbers[SUBSTEPS])):
        for j in range(memory.shape[2]):
            write_state(memory, b, j, current_substep(read_state(memory, b, j), read_inputs(memory, b, j), c))
