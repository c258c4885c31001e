/* What the firmware needs of its board. */
#ifndef BOARD_H
#define BOARD_H

double board_seconds(void); /* since the start */
unsigned board_stack(void); /* bytes of the stack that have ever been used */

#endif
