"""The views of a scene as files name them: unique names of images below one folder, and lenses."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from clsplat.errors import DataError, quoted
from clsplat.scene.images import is_image
from clsplat.scene.lens import Lens
from clsplat.scene.scene import Scene
from clsplat.scene.view import NO_FILE, View
from clsplat.scene.zoom import lens_of

IMAGES = "images"  # the folder of the photographs, as COLMAP and nerfstudio have it


@dataclass(frozen=True)
class Posed:
    """A view with the name of its image below the folder of all images, and its lens with distortion."""

    name: str
    view: View
    test: bool

    @property
    def lens(self) -> Lens:
        """The lens of the photograph as it is on disk: that of the view, or its pinhole camera."""
        return lens_of(self.view)


def posed(scene: Scene) -> list[Posed]:
    """Return the views in their order.  Raises DataError for names that no line of text can hold, or that repeat."""
    names = [_file_name(view) for view in scene.views]
    if all(name.startswith(f"{IMAGES}/") for name in names):
        names = [name.removeprefix(f"{IMAGES}/") for name in names]
    seen: set[str] = set()
    for name in names:
        if not name.isprintable() or name != name.strip():
            raise DataError(f"{scene.path}: an image is called {quoted(name)}; expected a name in one line of text")
        if name in seen:
            raise DataError(f"{scene.path}: two images would be called {quoted(name)}; rename one")
        seen.add(name)
    test = set(scene.test)
    return [Posed(name, view, i in test) for i, (name, view) in enumerate(zip(names, scene.views, strict=True))]


def _file_name(view: View) -> str:
    """A view's name with the suffix of its file, which some formats leave out."""
    name = PurePosixPath(view.name)
    if is_image(name) or view.image_path == NO_FILE:
        return view.name
    return f"{view.name}{view.image_path.suffix}"


def image_files(views: list[Posed], folder: Path) -> dict[Path, Path]:
    """Return where each photograph lies, by where it belongs below a folder.  Raises DataError without a photograph."""
    for one in views:
        if one.view.image_path == NO_FILE:
            raise DataError(f"the view {quoted(one.name)} has no photograph to copy; write the cameras alone")
    return {folder / one.name: one.view.image_path for one in views}
