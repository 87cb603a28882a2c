"""Shelves: bookcases, cube grids, ladders, racks, cabinets and chests of drawers, with books and boxes. Metres."""

import numpy as np

from data_gen.procedural.parts import Piece, four_legs, leg_style, turned_profile
from data_gen.shapes import finishes
from data_gen.shapes.primitives import Mesh, box, cylinder, lathe, merge, move, superellipsoid, tube, turn

BOARD = (0.012, 0.035)
SQUARE = [(1, 1), (-1, 1), (-1, -1), (1, -1)]  # section of a post


def carcass(width, height, depth, board) -> Mesh:
    """Two sides, a top and a bottom about x = z = 0, standing on y = 0."""
    sides = [move(box((board, height, depth), board * 0.1), s * (width - board) / 2, height / 2) for s in (1, -1)]
    lids = [move(box((width - board, board, depth * 0.995)), y=y) for y in (board / 2, height - board / 2)]
    return merge(sides + lids)


def bookcase(rng) -> list[Piece]:
    """Boards between two sides, at even or uneven heights; perhaps a back, feet, a plinth and a crown."""
    body = finishes.choose(rng, finishes.wood, finishes.wood, finishes.paint, finishes.metal)
    back = body if rng.random() < 0.5 else finishes.choose(rng, finishes.paint, finishes.wood, finishes.print_)
    width, height, depth = rng.uniform(0.4, 1.3), rng.uniform(0.7, 2.1), rng.uniform(0.22, 0.4)
    board, count = rng.uniform(*BOARD), int(rng.integers(2, 7))
    levels = np.linspace(0, height - board, count + 1)
    levels[1:-1] += rng.uniform(-0.25, 0.25, count - 1) * height / count * (rng.random() < 0.5)
    boards = [move(box((width - board, board, depth * 0.97)), y=y + board / 2) for y in levels[1:-1]]
    pieces = [(body, merge([carcass(width, height, depth, board), *boards]))]
    if rng.random() < 0.7:
        pieces.append((back, move(box((width - board, height - board, 0.008)), y=height / 2, z=-depth / 2 + 0.006)))
    books = finishes.swatches(rng)
    parts = rng.integers(1, 3) if width > 0.8 else 1
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        if parts == 2:
            pieces.append((body, move(box((board, high - low, depth * 0.96)), y=(low + high + board) / 2)))
        for side in range(parts):
            room = (width - board) / parts - board
            middle = (side - (parts - 1) / 2) * (width - board) / parts
            goods = contents(rng, books, room, high - low - board, depth)
            pieces += [(finish, move(mesh, middle, low + board)) for finish, mesh in goods]
    return on_base(rng, pieces, body, width, depth, board)


def on_base(rng, pieces, body, width, depth, board) -> list[Piece]:
    """The pieces, perhaps raised on legs or a plinth."""
    style = rng.choice(["none", "legs", "plinth"])
    if style == "none":
        return pieces
    rise = rng.uniform(0.05, 0.22) if style == "legs" else rng.uniform(0.03, 0.1)
    raised = [(finish, move(mesh, y=rise)) for finish, mesh in pieces]
    if style == "plinth":
        return [*raised, (body, move(box((width * 0.96, rise + 0.002, depth * 0.92)), y=rise / 2))]
    legs = four_legs(leg_style(rng, 0.02), width - 0.09, depth - 0.09, rise + board * 0.5, rng.uniform(0, 0.03))
    return [*raised, (body, legs)]


def contents(rng, books, room, height, depth) -> list[Piece]:
    """What stands on a board of a width (room) about x = 0 at y = 0, under a height: books, a box, a pot or nothing."""
    kind = rng.choice(["books", "pile", "box", "pot", "none"], p=[0.5, 0.1, 0.1, 0.1, 0.2])
    if kind == "books":
        return [(books, row_of_books(rng, room, height, depth))]
    if kind == "pile":
        count, meshes, y = int(rng.integers(2, 6)), [], 0.0
        for _ in range(count):
            thick = rng.uniform(0.015, 0.04)
            if y + thick > height:
                break
            book = turn(box((min(room, 0.26) * rng.uniform(0.7, 0.95), thick, depth * 0.6)), "y", rng.uniform(-6, 6))
            meshes.append(move(on_swatch(rng, book), y=y + thick / 2))
            y += thick
        return [(books, merge(meshes))]
    size = min(room, height, depth) * rng.uniform(0.5, 0.85)
    if kind == "box":
        return [(books, move(on_swatch(rng, box((size, size * 0.8, size), 0.01)), y=size * 0.4))]
    if kind == "pot":
        at, radius = turned_profile(rng, 12)
        pot = lathe(np.column_stack([radius * size * 0.4, at * size]), 16)
        return [(books, on_swatch(rng, pot))]
    return []


def on_swatch(rng, mesh: Mesh) -> Mesh:
    """The mesh in one of the plain colours of `finishes.swatches`, its lines across the mesh's height."""
    y = mesh.positions[:, 1]
    v = 0.05 + 0.9 * (y - y.min()) / np.ptp(y)
    u = (rng.integers(finishes.SWATCHES) + 0.5) / finishes.SWATCHES
    return mesh._replace(texcoords=np.column_stack([np.full(len(y), u), v]))


def row_of_books(rng, room, height, depth) -> Mesh:
    """Books side by side from one end of a board, some leaning at the end."""
    x, end = -room / 2, room * rng.uniform(-0.2, 0.5)
    tall, meshes = min(height * 0.92, rng.uniform(0.2, 0.34)), []
    while x < end:
        thick = rng.uniform(0.02, 0.06)
        if x + thick > room / 2:
            break
        high, deep = tall * rng.uniform(0.7, 1.0), depth * rng.uniform(0.6, 0.85)
        book = on_swatch(rng, box((thick * 0.97, high, deep)))
        meshes.append(move(book, x + thick / 2, high / 2, (depth - deep) * 0.3 - depth * 0.05))
        x += thick
    alone = move(box((room * 0.5, height * 0.3, depth * 0.5)), y=height * 0.15)
    return merge(meshes) if meshes else on_swatch(rng, alone)


def cube_grid(rng) -> list[Piece]:
    """Square cells, some with a box, a door or books."""
    body = finishes.choose(rng, finishes.wood, finishes.paint, finishes.paint)
    inset = finishes.choose(rng, finishes.fabric, finishes.paint, finishes.rattan)
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    if columns * rows == 1:
        rows = 3
    cell, depth, board = rng.uniform(0.26, 0.38), rng.uniform(0.26, 0.38), rng.uniform(*BOARD)
    width, height = columns * cell + board, rows * cell + board
    upright = box((board, height, depth * 0.98))
    uprights = [move(upright, (i / columns - 0.5) * (width - board), height / 2) for i in range(1, columns)]
    boards = [move(box((width, board, depth * 0.97)), y=i * cell + board / 2) for i in range(1, rows)]
    pieces = [(body, merge([carcass(width, height, depth, board), *uprights, *boards]))]
    pieces.append((body, move(box((width - board, height - board, 0.008)), y=height / 2, z=-depth / 2 + 0.006)))
    books = finishes.swatches(rng)
    for i in range(columns):
        for j in range(rows):
            x, y, room = (i + 0.5) * cell - columns * cell / 2, j * cell + board, cell - board
            if rng.random() < 0.35:
                tub = box((room * 0.95, room * 0.9, depth * 0.9), 0.01)
                pieces.append((inset, move(tub, x, y + room * 0.45)))
            else:
                goods = contents(rng, books, room * 0.95, room, depth)
                pieces += [(finish, move(mesh, x, y)) for finish, mesh in goods]
    return on_base(rng, pieces, body, width, depth, board)


def ladder(rng) -> list[Piece]:
    """Boards on two leaning or A-shaped sides, deeper towards the floor."""
    body = finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint)
    top = body if rng.random() < 0.4 else finishes.choose(rng, finishes.wood, finishes.paint)
    width, height, depth = rng.uniform(0.4, 0.9), rng.uniform(0.9, 1.9), rng.uniform(0.3, 0.5)
    count, rail, narrow = int(rng.integers(3, 6)), rng.uniform(0.012, 0.025), rng.uniform(0.3, 0.6)
    section = SQUARE if rng.random() < 0.6 else None
    meshes = []
    for s in (1, -1):
        ends = [
            ((s * width / 2, 0, z), (s * width / 2, height, -depth / 2 + (z + depth / 2) * narrow))
            for z in (depth / 2, -depth / 2)
        ]
        meshes += [tube(np.array(pair), rail, section=section) for pair in ends]
    books, pieces = finishes.swatches(rng), []
    for level in np.linspace(0.08, 0.97, count):
        deep = depth * (1 + (narrow - 1) * level)
        pieces.append((top, move(box((width, 0.022, deep), 0.003), y=level * height, z=(deep - depth) / 2)))
        if level < 0.9:
            goods = contents(rng, books, width - 0.06, 0.7 * height / count, deep)
            pieces += [(f, move(mesh, 0, level * height + 0.011, (deep - depth) / 2)) for f, mesh in goods]
    return [(body, merge(meshes)), *pieces]


def rack(rng) -> list[Piece]:
    """Posts and open boards, with braces: a store-room rack or a light etagere, loaded with boxes."""
    body = finishes.choose(rng, finishes.metal, finishes.paint)
    top = finishes.choose(rng, finishes.wood, finishes.metal, finishes.glass, finishes.paint)
    width, height, depth = rng.uniform(0.5, 1.6), rng.uniform(0.7, 2.0), rng.uniform(0.3, 0.6)
    post, count = rng.uniform(0.01, 0.035), int(rng.integers(2, 6))
    levels = np.linspace(rng.uniform(0.04, 0.15), 0.98, count) * height
    section = None if rng.random() < 0.4 else SQUARE
    posts = [
        tube([(x * width / 2, 0, z * depth / 2), (x * width / 2, height, z * depth / 2)], post, section=section)
        for x in (1, -1)
        for z in (1, -1)
    ]
    beams = [move(box((width, post * 2.2, post)), y=y - post, z=s * depth / 2) for y in levels for s in (1, -1)]
    braces = []
    if rng.random() < 0.6:
        for s in (1, -1):
            ends = [(s * width / 2, levels[0], -depth / 2), (-s * width / 2, levels[-1], -depth / 2)]
            braces.append(tube(ends, post * 0.35, segments=6))
    pieces = [(body, merge([*posts, *beams, *braces]))]
    pieces += [(top, move(box((width, 0.018, depth)), y=y)) for y in levels]
    boxes, books = finishes.choose(rng, finishes.paint, finishes.print_, finishes.rattan), finishes.swatches(rng)
    room = height / count * 0.75
    for y in levels[:-1]:
        x = -width / 2 + 0.05
        while rng.random() < 0.8:
            size = rng.uniform(0.12, 0.35)
            if x + size > width / 2:
                break
            tall = min(room, size * rng.uniform(0.5, 1.1))
            crate = move(box((size, tall, depth * rng.uniform(0.5, 0.85)), 0.006), x + size / 2, y + 0.009 + tall / 2)
            pieces.append((boxes, crate) if rng.random() < 0.5 else (books, on_swatch(rng, crate)))
            x += size + rng.uniform(0.01, 0.1)
    return pieces


def handle(rng, width) -> Mesh:
    """A knob, a bar or a cup, on the plane z = 0."""
    style = rng.choice(["knob", "bar", "cup"])
    if style == "knob":
        size = rng.uniform(0.02, 0.04)
        return superellipsoid((size, size, 0.05), 1, rng.choice([0.4, 1.0]), 8, 12)
    long = min(width * rng.uniform(0.2, 0.6), 0.3)
    if style == "bar":
        stands = [move(turn(cylinder(0.004, 0.026, 8), "x", 90), x=s * long * 0.4) for s in (1, -1)]
        return merge([tube([(-long / 2, 0, 0.026), (long / 2, 0, 0.026)], 0.006, segments=8), *stands])
    return superellipsoid((long * 0.6, 0.03, 0.05), 0.7, 0.7, 8, 14)


def drawer_stack(rng, body, fronts, width, height, depth, count) -> list[Piece]:
    """Pieces of a chest standing on y = 0: a case and its drawer fronts with handles."""
    pull = finishes.choose(rng, finishes.metal, finishes.wood, finishes.paint)
    knob = handle(rng, width)
    edges = np.linspace(0.02, height - 0.02, count + 1)
    if rng.random() < 0.5:
        edges = 0.02 + (height - 0.04) * np.linspace(0, 1, count + 1) ** rng.uniform(0.75, 1.0)
    pieces = [(body, move(box((width, height, depth), 0.003), y=height / 2))]
    bevel = rng.uniform(0.002, 0.008)
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        front = box((width - 0.03, high - low - 0.012, 0.024), bevel)
        pieces.append((fronts, move(front, y=(low + high) / 2, z=depth / 2)))
        pieces.append((pull, move(knob, y=(low + high) / 2, z=depth / 2 + 0.012)))
    return pieces


def chest(rng) -> list[Piece]:
    """A chest of drawers or a night stand, on legs or a plinth."""
    body = finishes.choose(rng, finishes.wood, finishes.wood, finishes.paint)
    fronts = body if rng.random() < 0.5 else finishes.choose(rng, finishes.wood, finishes.paint, finishes.print_)
    count = int(rng.integers(2, 6))
    width, height, depth = rng.uniform(0.4, 1.2), 0.12 * count + rng.uniform(0.1, 0.5), rng.uniform(0.35, 0.5)
    lid = box((width * 1.04, 0.025, depth * 1.06), 0.006, 3)
    pieces = [*drawer_stack(rng, body, fronts, width, height, depth, count), (body, move(lid, y=height + 0.012))]
    return on_base(rng, pieces, body, width, depth, 0.02)


def cabinet(rng) -> list[Piece]:
    """A cupboard or sideboard: panelled, glazed or plain doors, perhaps drawers above."""
    body = finishes.choose(rng, finishes.wood, finishes.wood, finishes.paint, finishes.metal)
    panel = finishes.choose(rng, finishes.glass, finishes.wood, finishes.paint, finishes.rattan)
    pull = finishes.choose(rng, finishes.metal)
    doors = int(rng.integers(1, 5))
    width, height, depth = doors * rng.uniform(0.3, 0.55), rng.uniform(0.6, 2.0), rng.uniform(0.3, 0.6)
    pieces = [(body, move(box((width, height, depth), 0.004), y=height / 2))]
    top = height
    if height < 1.2 and rng.random() < 0.5:
        tall = rng.uniform(0.14, 0.22)
        row = drawer_stack(rng, body, body, width, tall, depth, 1)[1:]
        pieces += [(finish, move(mesh, y=height - tall)) for finish, mesh in row]
        top = height - tall
    stile, plain = rng.uniform(0.04, 0.08), rng.random() < 0.3
    knob, each = handle(rng, 0.1), width / doors
    for i in range(doors):
        x, y = (i + 0.5) * each - width / 2, top / 2
        w, h = each - 0.012, top - 0.03
        if plain:
            pieces.append((panel if i % 2 else body, move(box((w, h, 0.02), 0.004), x, y, depth / 2 + 0.008)))
        else:
            rails = [move(box((stile, h, 0.024), 0.003), x + s * (w - stile) / 2, y, depth / 2 + 0.01) for s in (1, -1)]
            cross = box((w - stile, stile, 0.0235), 0.003)
            rails += [move(cross, x, y + s * (h - stile) / 2, depth / 2 + 0.01) for s in (1, -1)]
            fill = move(box((w - stile, h - stile, 0.012)), x, y, depth / 2 + 0.004)
            pieces += [(body, merge(rails)), (panel, fill)]
        hinge = 1 if i % 2 == 0 else -1
        pieces.append((pull, move(knob, x + hinge * (w / 2 - stile / 2), y, depth / 2 + 0.018)))
    if rng.random() < 0.5:
        crown = move(box((width * 1.05, 0.05, depth * 1.08), 0.02, 3), y=height + 0.02)
        pieces.append((body, crown))
    return on_base(rng, pieces, body, width, depth, 0.02)


STYLES = {bookcase: 0.3, cube_grid: 0.16, ladder: 0.12, rack: 0.14, cabinet: 0.16, chest: 0.12}
