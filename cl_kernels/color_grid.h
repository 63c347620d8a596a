/* The sizes of the color grids of photographs, which color_grid.cl reads and color_grid_table.cl updates: at most
 * MOST_NODES nodes along an axis, each with the ENTRIES of a matrix [E | b]. */
#ifndef CLSPLAT_COLOR_GRID_H
#define CLSPLAT_COLOR_GRID_H

#define ENTRIES 12     // entries of a matrix [E | b], row by row
#define MOST_NODES 16  // largest number of nodes along an axis

#endif
