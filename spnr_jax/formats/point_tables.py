"""Tables of points in text (.xyz .txt .csv .asc .pts) as named columns, piece by piece; names of columns without any.

Separators are commas, semicolons, bars, tabs or blanks, also at the end of a line.  A comma is a decimal one inside
quotes, or if something else separates the numbers; 1.234,5 has a thousand.  Lines of a single integer are counts of
points.  A header line, also one after #, % or //, names the columns; columns without a name, or of words, are not read.
Without a header the values decide what follows x y z: normals, r g b, alpha, roughness, metallic, intensity, others.
"""

import contextlib
import re
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import NORMAL, POSITION, Columns, Report, list_names, name_places

Line = tuple[int, str]  # line number in the file, from 1, and text

COLOR = ("r", "g", "b")
OPAQUE = (1, 255, 65535)  # usual constant values of alpha
UNIT_LENGTH = 0.02  # tolerance of the length of a normal
LUMINANCE = np.array([0.299, 0.587, 0.114])  # of sRGB (BT.601)
CLOSE = 0.15  # difference of correlations below which the choice of colour columns is reported as ambiguous
PIECE_LINES = 2**17  # in memory at a time
SHOWN, LONGEST_HEADER = 60, 4096  # characters of a line shown in errors, and searched for names
MOST_LINES, MOST_COLUMNS = 99, 16  # lines above the numbers searched for names; columns of an unnamed table
COMMENTS = ("#", "//", "%")
NUMBER = re.compile(r"[+-]?((\d+(\.\d*)?|\.\d+)([ed][+-]?\d+)?|nan|inf(inity)?)", re.IGNORECASE)
# separators of thousands, if a semicolon separates the numbers, and if not; the last mark in 1.234,5 is the decimal one
THOUSANDS = (
    re.compile(r"(?<=\d)(['’\ufffd\s](?=\d{3})|\.(?=\d{3}(\.\d{3}){0,3},\d)|,(?=\d{3}(,\d{3}){0,3}\.\d))"),
    re.compile(r"(?<=\d)['’\ufffd](?=\d{3})"),
)
PLAIN = re.compile(r"[-+.,\d\seE]*")  # a line as nearly all are
PACKED = re.compile(r"\s*(?:#|0x)([0-9a-f]{6})(?:(?<=#.{6})ff)?\s*", re.IGNORECASE)  # colour, opaque
COLORED = re.compile("col|rgb|hex|farbe|couleur|scalar|intensity")  # names of columns that may hold such words
COUNT = re.compile(r"\d+([\s;,]+\d+)?[\s;,]*")  # number of points, and optionally of columns
DECIMAL = re.compile(r"(?<!\d)0,|,(?!\d{3}(?!\w))")  # a comma that separates no thousands
WITH_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
EMPTY = {mark: re.compile(rf"(?:^|(?<={mark}))[^\S{mark}]*(?={mark}|$)") for mark in ",;\t"}  # a missing number
# missing numbers of C, Excel and databases
UNDEFINED = re.compile(r"[+-]?(nan\([a-z]*\)|1\.#\w+)|#n/?a|#nv|\b(n/?a|null|none)\b", re.IGNORECASE)
DASH = re.compile(r"(?<![^\s,;])-(?![^\s,;])")  # a missing number, but in the first row
FORTRAN = re.compile(r"(?<![#\w.])([+-]?(?:\d+(?:\.\d*)?|\.\d+))d(?=[+-]?\d)", re.IGNORECASE)  # exponents
WHOLE = re.compile(r"(?<=\d)\.0+(?![\d.ed])", re.IGNORECASE)
ONE_IN_BRACKETS = re.compile(r"[\[({][\d.,]+[])}]")  # accountants' negative numbers
UNITS = re.compile(r"[(\[](?![\d.]+[)\]])[^()\[\]]*[)\]]")  # but not numbers: "Roughness (0.1)" of CloudCompare
ONE_WORD = re.compile(r"(?=.*x)(?=.*y)(?=.*z)(n?[xyz]|[rgbai])+")  # all names, each of a letter
AROUND_NAMES = re.compile(r"^[^:=]*[:=]|[][(){}'\"]")  # "columns: [x, y, z]"
INDEX = "index"  # name of a column that is not used


class Head(NamedTuple):
    """The lines above the rows of numbers, the first row, and how its fields are separated."""

    before: list[str]
    first: Line
    delimiter: str | None  # None for blanks
    fields: list[str]


def text_pieces(path: Path, report: Report) -> Iterator[Columns]:
    """The columns of a text file, some points at a time; a line above the numbers may name them."""
    with open_text(path) as file:
        numbered = ((number, _plain(line)) for number, line in enumerate(file, 1))
        head, counted = _read_head(numbered), Counter[str]()
        lines = _rows_of_numbers(head, numbered, counted)
        words = {i for i, field in enumerate(head.fields) if not _is_number(field)}  # columns of words
        number, first = head.first
        broken = UserError(f"line {number}: expected {len(head.fields)} numbers, found {first[:SHOWN]!r}")
        names: tuple[str, ...] = ()
        while rows := list(islice(lines, PIECE_LINES)):
            counted["points"] += len(rows)
            try:
                table = _load_table(rows, head, words)
            except UserError as error:
                if names:
                    raise
                broken, words = error, words | _find_words(rows, head.delimiter)
                table = _load_table(rows, head, words)
            if not names:
                names = _names(head.before, table, words, path.suffix.lower(), report)
                if {names[i] for i in words} & {*POSITION, *COLOR}:
                    raise broken
                names = _name_words(names, table, words)
                if cut := [name for name, x in zip(names, table.T, strict=True) if name in POSITION and _are_cut(x)]:
                    numbers = "whole numbers among small ones of three decimals"
                    report(f"{numbers} in {', '.join(cut)}: write thousands without marks")
            yield {name: column for name, column in zip(names, table.T, strict=True) if name != INDEX}
        _report_counts(counted, report)


def _read_head(lines: Iterator[Line]) -> Head:
    """What stands above the numbers, and the first row of them; UserError if there is none."""
    before: deque[str] = deque(maxlen=MOST_LINES)
    for number, line in lines:
        words = re.split(r"[\s;,]+", line[:LONGEST_HEADER])
        numbered = words == list(map(str, range(len(words))))  # pandas' names of unnamed columns
        fields, above = ([*map(_is_number, _words(text))] for text in (line[:LONGEST_HEADER], ["", *before][-1]))
        below_names = len(fields) == len(above) and not any(above) and sum(fields) >= 3  # the row may begin with a word
        if (NUMBER.fullmatch(words[0]) or below_names) and not (COUNT.fullmatch(line[:SHOWN]) or numbered):
            delimiter = _find_delimiter(before, line)
            fields_of_first = [field.replace(",", ".") for field in line.split(delimiter)]
            return Head([*before], (number, line), delimiter, fields_of_first)
        if any(map(str.isalnum, line)):  # else a line of marks alone
            before.append(line[:LONGEST_HEADER])
    remark = next((text for line in reversed(before) if (text := line.lstrip("#/% "))), "")
    wanted = "expected rows of numbers, with a line of names above them if they begin with words"
    raise UserError(f"holds 0 points: {wanted}; found {remark[:SHOWN]!r}")


def _rows_of_numbers(head: Head, lines: Iterator[Line], counted: Counter[str]) -> Iterator[Line]:
    """The rows in a form that NumPy reads; counts what the file announces, and rows that are commented out."""
    names = {line for line in head.before if not NUMBER.match(line)}  # repeated where files were concatenated
    counts = (int(line[:SHOWN].split()[0]) for line in head.before if COUNT.fullmatch(line[:SHOWN]))
    counted["announced"] = max(counts, default=0)
    counted["commented"] = sum(_is_commented_row(line, len(head.fields)) for line in head.before)
    for number, text in chain([head.first], lines):
        if text.isdecimal():
            counted["announced"] += int(text[:SHOWN])
        elif text.startswith(COMMENTS):
            counted["commented"] += _is_commented_row(text, len(head.fields))
        elif text and text not in names:
            text = EMPTY[head.delimiter].sub("nan", text) if head.delimiter else text
            yield number, text if head.delimiter == "," else text.replace(",", ".")


def _load_table(rows: list[Line], head: Head, words: Collection[int]) -> np.ndarray:
    """The numbers of rows (points, columns); in columns of words, colours as numbers, else NaN."""
    converters = dict.fromkeys(words, _packed_color)
    return load_text(rows, "line", len(head.fields), head.delimiter, ndmin=2, converters=converters)


def _name_words(names: tuple[str, ...], table: np.ndarray, words: Collection[int]) -> tuple[str, ...]:
    """The names with those of columns of words marked; the first that holds colours is `rgb`."""
    of_words = {i: f"{names[i]} (words)" for i in words}
    hexadecimal = [i for i in sorted(words) if np.isfinite(table[:, i]).any() and COLORED.search(names[i])]
    of_words |= dict.fromkeys(hexadecimal[:1], "rgb")
    return tuple(of_words.get(i, name) if name != INDEX else name for i, name in enumerate(names))


def _report_counts(counted: Counter[str], report: Report) -> None:
    """Reports rows that are missing or not read."""
    points, announced = counted["points"], counted["announced"]
    if announced and announced != points:
        end = ": is the file cut off?" if announced > points else ""
        report(f"a line of the file announces {announced:,} points, {points:,} are there{end}")
    if counted["commented"]:
        report(f"{counted['commented']:,} rows that begin with a mark of remarks (# // %) are not read")


def _find_delimiter(before: Iterable[str], row: str) -> str | None:
    """What separates the numbers of a row: tabs if the line of names has as many; None for blanks."""
    if row.count("\t") in {line.count("\t") for line in before} - {0, 1}:
        return "\t"
    mark, parts = next((mark for mark in ";," if mark in row), None), row.split()
    decimal = mark == "," and len(parts) > 2 and all(map(WITH_COMMA.fullmatch, parts))
    return None if decimal else mark


def _find_words(rows: list[Line], delimiter: str | None) -> set[int]:
    """The columns of which most fields that are not empty are words, whatever the first row has there."""
    columns = zip(*(text.split(delimiter) for _, text in rows), strict=False)
    known = [[_is_number(x) for x in fields if x.strip().lower() not in ("", "nan")] for fields in columns]
    return {i for i, numbers in enumerate(known) if sum(numbers) < len(numbers) / 2}


def open_text(path: Path) -> TextIO:
    """A text file in UTF-8 or UTF-16."""
    with path.open("rb") as file:
        encoding = encoding_of(file.read(2))
    return path.open(encoding=encoding, errors="replace")


def decode_text(data: bytes) -> str:
    """The text of a file in UTF-8 or UTF-16; bytes of another code page become surrogates, so names stay apart."""
    encoding = encoding_of(data[:2])
    return data.decode(encoding, "surrogateescape" if encoding.startswith("utf-8") else "replace")


def encoding_of(head: bytes) -> str:
    """The encoding of text with these first bytes."""
    if 0 in head[:2]:
        return "utf-16-le" if head[0] else "utf-16-be"
    return "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def _plain(line: str) -> str:
    """The line without brackets, quotes and separators of thousands; commas inside quotes are decimal ones."""
    if PLAIN.fullmatch(text := line.strip()):
        return text
    text = text.strip("|").strip().replace("|", ";").replace("\N{MINUS SIGN}", "-")
    text = re.sub(r"^[^\W\d][\w.= ]*\(?(?=\[\[)", "", text)  # array([[ of NumPy
    if text[:1] in ("[", "(", "{") and not ONE_IN_BRACKETS.match(text):
        text = re.sub(r"[][(){}]", " ", text).strip(" ,;")
    if '"' in text:
        text = re.sub('"([^"]*)"?', lambda found: THOUSANDS[0].sub("", found[1]).replace(",", "."), text)
    return THOUSANDS[";" not in text].sub("", text)


def _words(line: str) -> list[str]:
    """The fields of a line."""
    mark = next((mark for mark in ";," if mark in line), None)
    return [word.strip("' \t") for word in (line.split(mark) if mark or "\t" not in line else re.split(r"\t+", line))]


def _is_commented_row(line: str, count: int) -> bool:
    """Whether a line is a remark that looks like a row of `count` fields."""
    fields = _words(line)
    return line.startswith(COMMENTS) and len(fields) == count and sum(map(_is_number, fields)) > 1


def _are_cut(values: np.ndarray) -> bool:
    """Whether numbers (n,) look as if marks of thousands were taken for decimal ones: 1.987 among 705 and 12."""
    size = np.abs(values[np.isfinite(values)])
    whole, small = size % 1 == 0, size[size % 1 != 0]
    if not 0.05 * len(size) < len(small) < 0.95 * len(size):
        return False
    three = np.abs(1000 * small - np.round(1000 * small)).max() < 1e-6
    return bool(three and small.min() >= 1 and 10 * small.max() < size[whole].max())


def _packed_color(word: str) -> float:
    """The number 0xRRGGBB of a word #rrggbb, NaN for other words."""
    return float(int(found[1], 16)) if (found := PACKED.fullmatch(word)) else np.nan


def _is_number(word: str) -> bool:
    return not (word := word.strip()) or any(form.fullmatch(word) for form in (NUMBER, UNDEFINED, WITH_COMMA))


def load_text(rows: Sequence[Line], what: str, count: int, delimiter: str | None = None, **layout: Any) -> np.ndarray:
    """The numbers of rows of `count` numbers each; missing ones are NaN.

    ValueError gives the number of the first row with other content; `what` is the word for a row.
    """

    def load(texts: list[str]) -> np.ndarray:
        table = np.loadtxt(texts, delimiter=delimiter, comments=None, **layout)
        if "dtype" not in layout and table.shape[1] != count:
            raise ValueError
        return table

    texts = [text for _, text in rows]
    with contextlib.suppress(ValueError):
        return load(texts)
    if delimiter is None and any(map(DECIMAL.search, texts)):
        texts = [text.replace(",", ".") for text in texts]
    texts = [FORTRAN.sub(r"\1e", WHOLE.sub("", UNDEFINED.sub("nan", DASH.sub("nan", text)))) for text in texts]
    with contextlib.suppress(ValueError):
        return load(texts)
    for (number, text), plain in zip(rows, texts, strict=True):
        try:
            load([plain])
        except ValueError:
            typed = " of the header's types" if "dtype" in layout and len(plain.split()) == count else ""
            raise UserError(f"{what} {number}: expected {count} numbers{typed}, found {text[:SHOWN]!r}") from None
    raise UserError(f"{what} {rows[0][0]}: expected {count} numbers in each row")


def _names(
    before: list[str], table: np.ndarray, unread: Collection[int], suffix: str, report: Report
) -> tuple[str, ...]:
    """Column names of a table: from a line above it that names positions, else from the values.

    `unread` are columns of words.
    """
    count, known = table.shape[1], np.flatnonzero(~np.isnan(table).all(axis=0))
    filled = 1 + int(max((2, *known, *unread)))
    found: list[tuple[list[str], list[str]]] = []  # names, and lines between them and the numbers
    unfit, below = list[str](), list[str]()
    for line in reversed(before):
        remark = line.lstrip("#/%;! ")
        plain = UNITS.sub("", line if remark == line else _plain(remark))
        names = _split_names(plain, filled, count)
        if line.startswith(COMMENTS) and not filled <= len(names) <= count:
            names = _split_names(AROUND_NAMES.sub(" ", plain).strip(" ,;"), filled, count)
        # V1, V2 ... of R and Matlab name nothing
        is_remark = line.startswith(COMMENTS) or NUMBER.match(line) or len({re.sub(r"\d", "", x) for x in names}) == 1
        if filled <= len(names) <= count and (name_places(names) or not is_remark):
            found.append((names, below.copy()))
        elif name_places(names) and not is_remark:
            unfit = unfit or names
        if not (line.startswith(COMMENTS) or COUNT.fullmatch(line[:SHOWN])):
            below.append(line)
    names, below = next((pair for pair in found if name_places(pair[0])), [*found, ([], [])][0])
    if below:
        report(f"lines below the names that are not read: {list_names(below[::-1])}")
    if names:
        names += [""] * (count - len(names))  # separators at the end of the line
        if twice := [x for i, x in enumerate(names) if x and x in names[:i]]:
            report(f"names that occur twice, of which the first column is read: {list_names(twice)}")
        return tuple(INDEX if not x or x in names[:i] else x for i, x in enumerate(names))
    if len(unfit) == count - 1 and len(table) > 1 and (np.diff(table[:, 0]) == 1).all():  # R: unnamed row numbers
        return (INDEX, *unfit)
    if unfit:
        hint = "; decimal commas need another separator" if count == 2 * len(unfit) else ""
        raise UserError(f"names {len(unfit)} columns ({' '.join(unfit)}) above {count} columns of numbers{hint}")
    orders = [re.findall(r"(?<![^\W_])[xyz](?![^\W_])", line.lower()) for line in before]
    if misread := [line for line, order in zip(before, orders, strict=True) if sorted(order) == [*"xyz"] < order]:
        report(f"lines that may name the columns in another order, and are not understood: {list_names(misread)}")
    of_format = suffix == ".pts" and filled == 7
    guessed = (*"xyz", "intensity", *COLOR) if of_format else plain_names(table[:, :filled], report)
    return (*guessed, *[INDEX] * (count - filled))


def _split_names(text: str, filled: int, count: int) -> list[str]:
    """The names in a line, in lower case, for a table of `count` columns, of which the first `filled` hold numbers."""
    names = [name.lower() for name in _words(text)]
    if "\t" in text and not filled <= len(names) <= count:  # tabs used as blanks
        names = text.lower().split()
    letters = re.findall("n?.", names[0]) if len(names) == 1 and ONE_WORD.fullmatch(names[0]) else []
    if filled <= len(letters) <= count:
        names = [name.replace("i", "intensity") for name in letters]
    while len(names) > filled and not names[-1]:
        names.pop()
    return names


def plain_names(table: np.ndarray, report: Report) -> tuple[str, ...]:
    """Guessed names of the columns of a table (points, columns) by their values; the first three are x y z.

    Normals are the first three columns that can be; colours the three most correlated ones that can be.
    """
    count = table.shape[1] if table.ndim == 2 and table.dtype.kind in "fiu" else 0
    if count < 3 or count > MOST_COLUMNS:
        raise UserError(
            f"has numbers of shape {table.shape} and type {table.dtype} without column names; expected rows of x y z "
            "(then intensity, r g b, nx ny nz, roughness metallic), or a header line that names the columns"
        )
    steps = np.diff(table[:, 0].astype(np.float64)) if count > 3 and len(table) > 2 else np.zeros(1)
    timed = count in (4, 5, 7, 10) and steps.min() > 0 and steps.std() < steps.mean() / 2
    whole = (table % 1 == 0).all(axis=0)
    pictured = count > 7 and whole[[0, 1, 5, 6, 7]].all() and not whole[2:5].any()  # pixels: row and column first
    first = 2 if pictured else int(timed or np.all(steps == 1))
    if first and count - first != 5:  # five columns after it: x of a profile, then y z r g b
        report(
            f"columns before x y z, which number or time the points: {first}; "
            "if that is wrong, or y comes before x, name the columns in a first line"
        )
        return (*first * [INDEX], *plain_names(table[:, first:], report))
    if (known := np.isfinite(table).all(axis=1)).any():
        table = table[known]
    names, threes, close = [*"xyz", *["scalar"] * (count - 3)], range(3, count - 2), list[int]()
    for i in [i for i in threes if _are_normals(table[:, i : i + 3], table[:, :3])][:1]:
        names[i : i + 3] = NORMAL
    free = [i for i in threes if names[i : i + 3] == 3 * ["scalar"] and not (table[:, i : i + 3] < 0).any()]
    if colored := [i for i in free if _are_colors(table[:, i : i + 3])] or free:
        alike = {i: _likeness(table, i) if len(table) > 2 else 0.0 for i in colored}
        start = max(colored, key=alike.__getitem__)
        names[start : start + 3] = COLOR
        rest, left = table[:, start + 3 :], count - start - 3
        share = rest.min(initial=0) >= 0 and rest.max(initial=0) <= 1 and not np.all(rest % 1 == 0)
        if left == 1 and (np.isin(rest, OPAQUE).all() or (share and table[:, 3:].max() <= 1 and np.median(rest) == 1)):
            names[-1] = "alpha"
        if left == 2 and share:
            names[-2:] = "roughness", "metallic"
        close = [
            i for i in colored if i != start and alike[i] > alike[start] - CLOSE and "alpha" not in names[i : i + 3]
        ]
    if names[3:4] == ["scalar"]:
        packed = count == 4 and whole[3] and OPAQUE[-1] < np.median(table[:, 3]) <= table[:, 3].max() < 2**24
        packed = packed and bool((np.diff(table[:, 3]) < 0).any())  # sorted: numbers or times of the points
        names[3] = "rgb" if packed else "intensity"
    if count > 3:
        others = [f"; r g b may as well be columns {i + 1} to {i + 3}: name them in a first line" for i in close[:1]]
        report(f"the {count} columns, which have no names, taken as {' '.join(names)}{''.join(others)}")
    return tuple(names)


def _are_normals(vectors: np.ndarray, positions: np.ndarray) -> bool:
    """Whether vectors (n, 3) have unit length and are not colours: some are negative, or all normal to a plane."""
    lengths = np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)
    plane = np.ptp(vectors, axis=0).max() == 0 and np.ptp(positions @ vectors[0]) < UNIT_LENGTH * np.ptp(positions)
    return bool(((vectors < 0).any() or plane) and np.median(np.abs(lengths - 1)) < UNIT_LENGTH)


def _are_colors(values: np.ndarray) -> bool:
    """Whether values (n, 3) are 0 to 1, or integers of at most 16 bits, with channels of similar range."""
    highest = values.max(axis=0)
    whole = highest.max() <= OPAQUE[-1] and np.all(values % 1 == 0)
    return bool(values.min() >= 0 and highest.min() >= highest.max() / 16 and (whole or highest.max() <= 1))


@np.errstate(invalid="ignore")  # of a constant column
def _likeness(table: np.ndarray, start: int) -> float:
    """The smaller correlation of neighbouring columns among the three from `start`; 0 if one is constant.

    2 if a column beside them is their luminance.
    """
    values = np.asarray(table[:, start : start + 3], np.float64)
    luminance, rounding = values @ LUMINANCE, 1.5 if values.max() > 2 else 0.006
    for beside in {start - 1, start + 3} & {*range(3, table.shape[1])}:
        if np.ptp(table[:, beside]) and np.median(np.abs(table[:, beside] - luminance)) <= rounding:
            return 2.0
    correlation = np.abs(np.corrcoef(values.T))
    return max(0.0, round(float(np.min([correlation[0, 1], correlation[1, 2]])), 1))
