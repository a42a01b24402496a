// rigd/pieces.h - which of the pieces that a solve needs lie in a take: solver/take/take.h's answer, as plain paths.
//
// A file of its own because the ledger and the solver's take share names.
#pragma once

struct pieces {
    char mesh[800], cameras[800], panorama[800], start[800]; // absolute if the take's folder is; "": none
    int n_views;
};

int pieces_find(struct pieces *out, const char *take_dir); // 0 or -errno (logged)
