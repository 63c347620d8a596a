"""Datasets in host memory.  This module exports the names that a reader for another format needs; see `Reader`."""

from clsplat.core.reading import read_file as read_file
from clsplat.scene.camera import Camera as Camera
from clsplat.scene.colmap import pose_matrix as pose_matrix
from clsplat.scene.detect import read_scene as read_scene
from clsplat.scene.lookup import require_files as require_files
from clsplat.scene.lookup import safe_join as safe_join
from clsplat.scene.reader import Parts as Parts
from clsplat.scene.reader import Reader as Reader
from clsplat.scene.scene import PointCloud as PointCloud
from clsplat.scene.scene import Scene as Scene
from clsplat.scene.scene import every_nth as every_nth
from clsplat.scene.scene import make_scene as make_scene
from clsplat.scene.view import View as View
from clsplat.scene.view_selection import Split as Split
from clsplat.scene.view_selection import ViewSelection as ViewSelection
