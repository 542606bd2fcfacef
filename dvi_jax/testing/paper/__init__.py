"""The paper, reproduced: its figures redrawn, its claims measured and judged."""

from ._reproduce import reproduce as reproduce
