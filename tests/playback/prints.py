"""What is asked of figures for print."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from swarmsim.playback import plan


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_visible() and text.get_text()]


def labels(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def check_print(figure: Figure) -> None:
    """A column wide, letters of a readable size, nothing cut off."""
    figure.canvas.draw()
    width = figure.get_figwidth()
    assert width in (plan.SINGLE_COLUMN_IN, plan.DOUBLE_COLUMN_IN)
    assert min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) >= 6.9
    ink = figure.get_tightbbox(figure.canvas.get_renderer())
    assert ink.x0 >= 0.0, "cut off on the left"
    assert ink.y0 >= 0.0, "cut off at the bottom"
    assert ink.x1 <= width, "cut off on the right"
    assert ink.y1 <= figure.get_figheight(), "cut off at the top"
