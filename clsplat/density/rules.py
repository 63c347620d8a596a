"""All density rules by the names that pipelines give them."""

from typing import Annotated

from pydantic import Field

from clsplat.density.basic import Clone, PruneFaint, PruneLarge, Split
from clsplat.density.detail import SplitOversized, SplitTextured
from clsplat.density.edit import Rule
from clsplat.density.thinning import MergeNeighbours, PruneUnimportant

RULES: dict[str, type[Rule]] = {
    "clone": Clone,
    "split": Split,
    "split_textured": SplitTextured,
    "split_oversized": SplitOversized,
    "prune_faint": PruneFaint,
    "prune_large": PruneLarge,
    "prune_unimportant": PruneUnimportant,
    "merge_neighbours": MergeNeighbours,
}
AnyRule = Annotated[
    Clone | Split | SplitTextured | SplitOversized | PruneFaint | PruneLarge | PruneUnimportant | MergeNeighbours,
    Field(discriminator="type"),
]
