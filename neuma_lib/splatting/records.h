// Functions of records.py, which replaces REAL and SPLAT_SIZE. Four numbers are one access of 16 bytes on a GPU in
// single precision.
//// piece
    struct alignas(16) Piece { REAL c[4]; };
    Piece* pieces = (Piece*)(records.data + ((long long)image * records.shape[1] + g) * SPLAT_SIZE);

//// load
    const Piece found = pieces[piece];
    return {found.c[0], found.c[1], found.c[2], found.c[3]};

//// store
    pieces[piece] = Piece{{a, b, c, d}};
