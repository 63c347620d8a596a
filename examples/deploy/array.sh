#!/bin/bash
# The cells of a matrix as the tasks of a SLURM job array, one cell a task:
#   sbatch --array=0-11 array.sh filters.yaml /shared/store
# 0-11: the cells, counted from 0. The store lies on the shared file system. A task that was stopped or lost is
# submitted again, and goes on from its checkpoint; a cell that is in the store is not run again.
#SBATCH --job-name=clsplat
#SBATCH --cpus-per-task=4
#SBATCH --mem=16G
#SBATCH --time=04:00:00
# two minutes before the end, so that the cell saves its state
#SBATCH --signal=B:TERM@120
# a graphics card:
##SBATCH --gres=gpu:1

exec clsplat cell "$1" --index "$SLURM_ARRAY_TASK_ID" --store "$2"
