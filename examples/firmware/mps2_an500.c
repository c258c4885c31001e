/* Start, clock and stack of QEMU's mps2-an500, an Arm MPS2 with a Cortex-M7 at 25 MHz. */
#include <stdint.h>
#include <stdlib.h>

#include "board.h"

#define CPACR (*(volatile uint32_t *)0xE000ED88) /* Armv7-M manual, B3.2.20 */
#define TIMER ((volatile uint32_t *)0x40000000)  /* CMSDK APB timer 0: control, value, reload */
#define TIMER_HZ 25e6
#define PAINT 0xA5A5A5A5u
#define UNPAINTED 256 /* bytes below the frame that paints */

extern uint32_t stack_end[], stack_top[], data_begin[], data_end[], bss_begin[], bss_end[];
extern const uint32_t data_in_flash[];
extern void initialise_monitor_handles(void); /* of newlib's semihosting */
int main(void);

double board_seconds(void) { return (double)(UINT32_MAX - TIMER[1]) / TIMER_HZ; }

unsigned board_stack(void) {
    const uint32_t *at = stack_end;
    while (*at == PAINT) ++at;
    return (unsigned)((const char *)stack_top - (const char *)at);
}

static void start(void) {
    const uint32_t *from = data_in_flash;
    CPACR |= 0xFu << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    for (uint32_t *at = data_begin; at < data_end; ++at) *at = *from++;
    for (uint32_t *at = bss_begin; at < bss_end; ++at) *at = 0;
    uint32_t *here = (uint32_t *)((char *)__builtin_frame_address(0) - UNPAINTED);
    for (uint32_t *at = stack_end; at < here; ++at) *at = PAINT;
    TIMER[2] = TIMER[1] = UINT32_MAX;
    TIMER[0] = 1;
    initialise_monitor_handles();
    exit(main());
}

static void fault(void) { exit(EXIT_FAILURE); }

/* Stack, start, then the exceptions up to the usage fault; no interrupt is used. */
__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    stack_top, start, fault, fault, fault, fault, fault};
