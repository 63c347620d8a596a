"""All density rules by the names that pipelines give them."""

from typing import Annotated

from pydantic import Field

from clsplat.training.basic_rules import Clone, PruneFaint, PruneLarge, Split
from clsplat.training.density import Rule
from clsplat.training.detail_rules import SplitOversized, SplitTextured
from clsplat.training.thinning_rules import MergeNeighbours, PruneUnimportant

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
