/* The sizes of the grids of the photographs' colours (colour_grid.cl, colour_grid_table.cl). */
#ifndef CLSPLAT_COLOUR_GRID_H
#define CLSPLAT_COLOUR_GRID_H

#define ENTRIES 12     // of a matrix [E | b], row by row
#define MOST_NODES 16  // of an axis

#endif
