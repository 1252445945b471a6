"""What a user typed: scenes with another film size, integrators with typed keys."""

import mitsuba as mi
import numpy as np
import pytest

from mi_neural.bench import benchmark, load
from mi_neural.bench.specs import IntegratorSpec, build_integrator, parse_integrator


def test_size_overrides_film_and_crop(tmp_path):
    scene = tmp_path / "cropped.xml"
    scene.write_text("""<scene version="3.0.0">
        <default name="depth" value="3"/>
        <integrator type="path"> <integer name="max_depth" value="$depth"/> </integrator>
        <sensor type="perspective">
            <film type="hdrfilm">
                <integer name="width" value="64"/> <integer name="height" value="32"/>
                <integer name="crop_width" value="8"/> <integer name="crop_height" value="32"/>
                <integer name="crop_offset_x" value="4"/> <integer name="crop_offset_y" value="0"/>
            </film>
        </sensor>
        <emitter type="constant"/>
    </scene>""")
    assert load.load_scene(str(scene)).size == (8, 32)
    assert load.load_scene(str(scene), (20, 10)).size == (20, 10)
    assert load.load_scene(str(scene), None, {"depth": "7"}).carried == {"max_depth": 7}
    with pytest.raises(load.InputError, match=r"no parameter foo; it has: depth"):
        load.load_scene(str(scene), None, {"foo": "1"})


def boxes(path, *shapes: str) -> str:
    """A scene of shapes of one material."""
    material = '<bsdf type="twosided" id="white"> <bsdf type="diffuse"/> </bsdf>'
    path.write_text(f"""<scene version="3.0.0"> <sensor type="perspective"/> <emitter type="constant"/> {material}
        {" ".join(shapes)} </scene>""")
    return str(path)


WHITE = '<ref id="white" name="bsdf"/>'
METER = """<shape type="rectangle"> {} <sensor type="irradiancemeter"> <film type="hdrfilm">
    <integer name="width" value="1"/> <integer name="height" value="1"/> <rfilter type="box"/> </film>
    </sensor> </shape>"""


def test_scenes_are_merged_unless_they_cannot_be(tmp_path):
    """Mitsuba 3.9.1 refuses to join a rectangle and a cube with flipped normals, and makes equal sensors one, which it
    then refuses on two shapes."""
    cubes = [f'<shape type="cube" id="c{k}"> {WHITE} </shape>' for k in range(3)]
    file = boxes(tmp_path / "a.xml", *cubes)
    merged, apart = load.load_scene(file), load.load_scene(file, merge=False)
    assert merged.merged and len(merged.scene.shapes()) == 1
    assert not apart.merged and {s.id() for s in apart.scene.shapes()} == {"c0", "c1", "c2"}
    flipped = f'<shape type="cube"> <boolean name="flip_normals" value="true"/> {WHITE} </shape>'
    plane = f'<shape type="rectangle"> {WHITE} </shape>'
    loaded = load.load_scene(boxes(tmp_path / "b.xml", plane, flipped))
    assert not loaded.merged and len(loaded.scene.shapes()) == 2
    move = '<transform name="to_world"> <translate x="3"/> </transform>'
    assert not load.load_scene(boxes(tmp_path / "c.xml", METER.format(""), METER.format(move))).merged


def test_emitters_keep_the_order_of_the_file_in_a_merged_scene():
    """Mitsuba 3.9.1 puts what it joins in the order of addresses: 32 lamps, another order in each process."""
    merged, apart = (load.load_scene("lamp_bays", merge=merge).scene for merge in (True, False))
    assert len(merged.shapes()) < len(apart.shapes())
    corners = [[np.array(e.get_shape().bbox().min).ravel() for e in scene.emitters()] for scene in (merged, apart)]
    assert len(corners[0]) == 32 and np.array_equal(*corners)


def test_what_is_wrong_is_said_where_merging_is_not_why(tmp_path):
    with pytest.raises(load.InputError, match=r"cannot load .*no\.ply"):
        mesh = '<shape type="ply"> <string name="filename" value="no.ply"/> </shape>'
        load.load_scene(boxes(tmp_path / "a.xml", mesh))
    with pytest.raises(load.InputError, match=r"no key 'depht'"):
        load.load_scene("cornell_box", integrator_keys={"depht": 3})


def test_keys_are_typed():
    spec = parse_integrator("nirc:a=8,b=0.5,c=true,d=text,e.f=1e-3")
    assert spec.keys == {"a": 8, "b": 0.5, "c": True, "d": "text", "e.f": 1e-3}
    assert [type(v) for v in spec.keys.values()] == [int, float, bool, str, float]
    assert spec.label == "nirc:a=8,b=0.5,c=true,d=text,e.f=0.001"


def test_size_nearest_in_shape_is_taken():
    sizes = [(32, 18), (20, 20)]
    assert load.load_scene("cornell_box", sizes).size == (20, 20)
    assert load.load_scene("ajar_door", sizes).size == (32, 18)


def test_digest_follows_what_a_scene_includes_and_names(tmp_path):
    def digest() -> str:
        return load.load_scene(str(tmp_path / "scene.xml"), (8, 8)).digest

    (tmp_path / "scene.xml").write_text("""<scene version="3.0.0"> <include filename="part.xml"/>
        <sensor type="perspective"/> <emitter type="constant"/> </scene>""")
    part = """<scene version="3.0.0"> <shape type="ply"> <string name="filename" value="m.ply"/> </shape> {} </scene>"""
    (tmp_path / "part.xml").write_text(part.format(""))
    ply = mi.Mesh("m", 3, 1)
    params = mi.traverse(ply)
    params["vertex_positions"], params["faces"] = [0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 1, 2]
    params.update()
    ply.write_ply(str(tmp_path / "m.ply"))
    before = digest()
    assert before == digest()
    (tmp_path / "part.xml").write_text(part.format("<!-- another -->"))
    included = digest()
    params["vertex_positions"] = [0, 0, 0, 2, 0, 0, 0, 1, 0]
    params.update()
    ply.write_ply(str(tmp_path / "m.ply"))
    assert len({before, included, digest()}) == 3


def test_depth_is_carried_where_it_is_known():
    carried = {"max_depth": 5, "hide_emitters": True}
    _, keys = build_integrator(IntegratorSpec("path", {"max_depth": 3}), carried)
    assert keys == {"max_depth": 3, "hide_emitters": True}
    _, keys = build_integrator(IntegratorSpec("direct"), carried)
    assert keys == {"hide_emitters": True}


def test_a_key_that_no_integrator_knows_is_refused():
    loaded = load.load_scene("cornell_box", (16, 12))
    with pytest.raises(load.InputError, match="none of path, direct has a key 'zork'"):
        benchmark.make_cases(loaded, [IntegratorSpec("path"), IntegratorSpec("direct")], {"zork": 1})
