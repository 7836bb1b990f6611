"""A Cortex-M4 that QEMU emulates, for a program that filters a log: start-up code, memory map, and commands.

The machine is ARM's MPS2 with the image AN386. Standard input and output of the program are those of the emulator,
by semihosting.
"""

from filters.c.sizes import CORTEX_M4

BOARD = """\
extern void _start(void);

static void reset(void)
{
    *(volatile unsigned *)0xE000ED88u |= 0xF00000u; /* the floating-point unit */
    _start();
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x20400000u, reset};
"""
MEMORY = """\
ENTRY(_start)
MEMORY
{
    CODE (rx) : ORIGIN = 0x00000000, LENGTH = 4M
    DATA (rwx) : ORIGIN = 0x20000000, LENGTH = 4M
}
SECTIONS
{
    .vectors : { KEEP(*(.vectors)) } > CODE
    .text : { *(.text*) *(.rodata*) KEEP(*(.init)) KEEP(*(.fini)) } > CODE
    .ARM.exidx : { *(.ARM.exidx*) } > CODE
    .data : {
        *(.data*) . = ALIGN(8);
        __preinit_array_start = .; KEEP(*(.preinit_array)) __preinit_array_end = .;
        __init_array_start = .; KEEP(*(.init_array*)) __init_array_end = .;
        __fini_array_start = .; KEEP(*(.fini_array*)) __fini_array_end = .;
    } > DATA
    .bss : { __bss_start__ = .; *(.bss*) *(COMMON) __bss_end__ = .; } > DATA
    end = ALIGN(8);
    __end__ = end;
}
"""
BUILD = (
    "arm-none-eabi-gcc {flags} "
    f"{CORTEX_M4} --specs=rdimon.specs -T board.ld "
    "{name}.c main.c board.c -lm -o {name}.elf"
)
EMULATE = (
    "qemu-system-arm -M mps2-an386 -nographic -monitor none -serial none "
    "-semihosting-config enable=on,target=native -kernel {name}.elf"
)
README = """
## On an emulated controller

On a Cortex-M4 that QEMU emulates (gcc-arm-none-eabi and qemu-system-arm of Debian):

    {build}
    {emulate} < log.csv > estimates.csv
"""
