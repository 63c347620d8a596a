"""Names of files in the folders between photographs and cameras."""

DATABASE, IMAGES, PAIRS, MODEL = "database.db", "images", "pairs.txt", "sparse"
MATCHING = "matching.json"  # how photographs were matched, for further attempts
