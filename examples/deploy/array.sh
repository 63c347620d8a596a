#!/bin/bash
# Run the cells of a matrix as a SLURM job array, one cell per task:
#   sbatch --array=0-11 array.sh filters.yaml /shared/store
# Cells are numbered from 0; the store is on the shared file system. Resubmit tasks that were stopped or lost; they resume
# from their checkpoints, and cells that are already in the store are skipped.
#SBATCH --job-name=clsplat
#SBATCH --cpus-per-task=4
#SBATCH --mem=16G
#SBATCH --time=04:00:00
# SIGTERM two minutes before the time limit, so that the cell saves its state
#SBATCH --signal=B:TERM@120
# for a GPU:
##SBATCH --gres=gpu:1

exec clsplat cell "$1" --index "$SLURM_ARRAY_TASK_ID" --store "$2"
