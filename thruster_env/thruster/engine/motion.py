"""How a block of copies moves in one sample time: amplifier's input, state, noise and thrust.

The equations of motion are those of `dynamics`; here they meet the memory. Everything works on `memory[b]`, see
`thruster_env.thruster.engine.memory`.
"""

from __future__ import annotations

from thruster_env.core.compiled import inlined
from thruster_env.core.memory import KEY_0, KEY_1, REWARD, STEP
from thruster_env.core.streams import INITIAL, PROCESS, normal_block
from thruster_env.core.tuples import vector_reader, written_out
from thruster_env.thruster.dynamics import Constants, substep, thrust_and_torque
from thruster_env.thruster.engine.memory import (
    AMBIENT,
    COMMAND,
    CONSTANT_COUNT,
    CONSTANT_ROWS,
    FLOW,
    LINEAR,
    LINEAR_MODEL,
    NEXT_REFERENCE,
    OMEGA,
    PRIOR_MEAN,
    PRIOR_ROOT,
    Q_ROOT,
    SUBSTEPS,
    THRUST,
    TOP_VOLTAGE,
    VOLTAGE,
)

read_constants = vector_reader(CONSTANT_COUNT)
drawn_constants = written_out(
    "drawn_constants",
    "memory, b, first, j",
    f"Constants({', '.join(f'memory[b, first + {i}, j]' for i in range(CONSTANT_COUNT))})",
    Constants=Constants,
)


@inlined
def constants_of_copy(memory, b, drawn, j, numbers):
    """Constants of copy j: those drawn for it, from row `drawn` on, the nominal ones where that is 0."""
    if drawn > 0:
        return drawn_constants(memory, b, drawn, j)
    return Constants(*read_constants(numbers))


@inlined
def draw_initial_state(memory, b, numbers):
    """Draw the initial state of every copy from its key, and forget the last episode."""
    mean_0, mean_1 = numbers[PRIOR_MEAN], numbers[PRIOR_MEAN + 1]
    root_00, root_10, root_11 = numbers[PRIOR_ROOT], numbers[PRIOR_ROOT + 1], numbers[PRIOR_ROOT + 2]
    for j in range(memory.shape[2]):
        w0, w1, _, _ = normal_block(0, 0, INITIAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
        memory[b, OMEGA, j] = mean_0 + root_00 * w0
        memory[b, FLOW, j] = mean_1 + root_10 * w0 + root_11 * w1
        memory[b, COMMAND, j] = 0.0
        memory[b, REWARD, j] = 0.0
        memory[b, NEXT_REFERENCE, j] = 0.0


@inlined
def clip_command(memory, b, numbers):
    """Clip the commanded voltage to the action space, and hand it to the amplifier."""
    top = numbers[TOP_VOLTAGE]
    for j in range(memory.shape[2]):
        voltage = min(max(memory[b, COMMAND, j], -top), top)
        memory[b, COMMAND, j] = voltage
        memory[b, VOLTAGE, j] = voltage


@inlined
def move_thruster(memory, b, numbers):
    """Integrate the equations of motion over one sample time."""
    c = Constants(*read_constants(numbers))
    for _ in range(int(numbers[SUBSTEPS])):
        for j in range(memory.shape[2]):
            u = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
            omega, flow = substep((memory[b, OMEGA, j], memory[b, FLOW, j]), u, c)
            memory[b, OMEGA, j] = omega
            memory[b, FLOW, j] = flow


@inlined
def find_thrust(memory, b, numbers):
    """Thrust of every copy."""
    c = Constants(*read_constants(numbers))
    for j in range(memory.shape[2]):
        memory[b, THRUST, j], _ = thrust_and_torque((memory[b, OMEGA, j], memory[b, FLOW, j]), c)


@inlined
def move_any(memory, b, numbers):
    """The same for every kind of plant: with parameters drawn for each copy, and for a linear system."""
    if numbers[LINEAR] > 0.0:
        at = LINEAR_MODEL
        for j in range(memory.shape[2]):
            omega, flow = memory[b, OMEGA, j], memory[b, FLOW, j]
            voltage, ambient = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
            driven_0 = numbers[at + 4] * voltage + numbers[at + 5] * ambient
            driven_1 = numbers[at + 6] * voltage + numbers[at + 7] * ambient
            memory[b, OMEGA, j] = numbers[at] * omega + numbers[at + 1] * flow + driven_0
            memory[b, FLOW, j] = numbers[at + 2] * omega + numbers[at + 3] * flow + driven_1
    elif numbers[CONSTANT_ROWS] > 0.0:
        first = int(numbers[CONSTANT_ROWS])
        for _ in range(int(numbers[SUBSTEPS])):
            for j in range(memory.shape[2]):
                c = drawn_constants(memory, b, first, j)
                u = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
                omega, flow = substep((memory[b, OMEGA, j], memory[b, FLOW, j]), u, c)
                memory[b, OMEGA, j] = omega
                memory[b, FLOW, j] = flow
    else:
        move_thruster(memory, b, numbers)


@inlined
def find_any_thrust(memory, b, numbers):
    """The same for every kind of plant."""
    if numbers[LINEAR] > 0.0:
        by_speed, by_flow = numbers[LINEAR_MODEL + 8], numbers[LINEAR_MODEL + 9]
        for j in range(memory.shape[2]):
            memory[b, THRUST, j] = by_speed * memory[b, OMEGA, j] + by_flow * memory[b, FLOW, j]
    elif numbers[CONSTANT_ROWS] > 0.0:
        first = int(numbers[CONSTANT_ROWS])
        for j in range(memory.shape[2]):
            c = drawn_constants(memory, b, first, j)
            memory[b, THRUST, j], _ = thrust_and_torque((memory[b, OMEGA, j], memory[b, FLOW, j]), c)
    else:
        find_thrust(memory, b, numbers)


@inlined
def add_process_noise(memory, b, numbers):
    """Add w ~ N(0, Q) to the state."""
    root_00, root_10, root_11 = numbers[Q_ROOT], numbers[Q_ROOT + 1], numbers[Q_ROOT + 2]
    for j in range(memory.shape[2]):
        w0, w1, _, _ = normal_block(0, memory[b, STEP, j], PROCESS, memory[b, KEY_0, j], memory[b, KEY_1, j])
        memory[b, OMEGA, j] += root_00 * w0
        memory[b, FLOW, j] += root_10 * w0 + root_11 * w1
