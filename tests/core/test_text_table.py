"""The text table: aligned, never cut, and plain."""

from vsfsim.core.text_table import text_table


def test_columns_are_aligned_and_a_rule_is_as_long_as_the_head():
    assert text_table(["#", "method"], [["1", "gaussian"], ["10", "zero"]]) == (
        "#   method\n"
        "------------\n"
        "1   gaussian\n"
        "10  zero")
    assert text_table(["a", "long"], [["1.5", "2"]], right=True, rule=False) == "  a  long\n1.5     2"


def test_no_cell_is_cut_wrapped_or_read_as_markup():
    cells = ["x" * 300, "[bold]as it is[/bold]", ":smile: ± 1"]
    lines = text_table(["one", "two", "three"], [cells]).split("\n")
    assert len(lines) == 3 and all(cell in lines[2] for cell in cells)
