/* The sizes of the grids of the photographs' colors, which color_grid.cl reads and color_grid_table.cl updates: each
 * of at most MOST_NODES nodes along an axis has the ENTRIES of a matrix [E | b]. */
#ifndef CLSPLAT_COLOR_GRID_H
#define CLSPLAT_COLOR_GRID_H

#define ENTRIES 12     // of a matrix [E | b], row by row
#define MOST_NODES 16  // of an axis

#endif
