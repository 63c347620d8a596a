/* Planes of the table `motion`, [W,S], that every moving Gaussian has, for any polynomial: the time of its mean, and
 * the logarithm of its duration.  motion.cl describes the others, with the formulas. */
#ifndef CLSPLAT_MOTION_H
#define CLSPLAT_MOTION_H
#include "lanes.h"

#define MOTION_CENTER 3u    // time of the mean
#define MOTION_DURATION 4u  // log of the duration

#endif
