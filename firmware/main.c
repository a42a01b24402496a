// firmware/main.c - the board's only loop.
#include "firmware/board.h"
#include "firmware/session.h"

int main(void)
{
    board_start();
    session_start(); // everything is known to be released before the first interrupt
    board_run();
    for (;;) {
        board_poll();
        session_run();
    }
}
