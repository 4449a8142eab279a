"""Small models, each with one feature of MuJoCo: what engine=mjx either simulates as C MuJoCo does, or refuses."""

# ruff: noqa: E501

from __future__ import annotations

#: Two links and a ball that can touch the floor. Parts are put in by name.
MODEL = """
<mujoco><compiler angle="radian" autolimits="true"/>{extension}
  <option timestep="0.005" {option}>{flag}</option>{default}
  <worldbody>{world}<geom name="floor" type="plane" size="3 3 .1" {floor}/>
    <body name="upper" pos="0 0 1" {upper_body}><joint name="a" axis="0 1 0" damping=".5" {joint}/>
      <geom name="upper" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5" {upper}/>
      <site name="s1" pos=".1 0 .05"/>
      <body name="fore" pos=".3 0 0"><joint name="b" axis="0 1 0" damping=".5" {second}/>
        <geom name="fore" type="capsule" fromto="0 0 0 .3 0 0" size=".025" mass=".3" {fore}/>
        <site name="s2" pos=".3 0 0"/></body></body>
    <body name="ball" pos="1 0 {height}">{free}<geom name="ball" {ball}/><site name="s3"/></body>
    {more}
  </worldbody>{rest}
  <actuator><motor name="m" joint="a" gear="2" ctrlrange="-1 1" {motor}/>{actuator}</actuator>
</mujoco>"""

DEFAULTS = {
    **dict.fromkeys(
        [
            "extension",
            "option",
            "flag",
            "default",
            "world",
            "floor",
            "upper_body",
            "joint",
            "upper",
            "second",
            "fore",
            "more",
        ],
        "",
    ),
    **dict.fromkeys(["rest", "motor", "actuator"], ""),
    "height": ".3",
    "free": "<freejoint/>",
    "ball": 'type="sphere" size=".1" mass="1"',
}


def _tendon(inside: str, more: str = "") -> dict[str, str]:
    return {"rest": f"<tendon>{inside}</tendon>{more}"}


_FIXED = '<fixed name="t" {}><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed>'
_SPATIAL = '<spatial name="t" {}><site site="s1"/><site site="s2"/></spatial>'
_WRAPPED = '<spatial name="t" stiffness="20"><site site="s1"/><geom geom="ball"/><site site="s2"/></spatial>'

#: One feature each; every actuated model gets the same controls.
FEATURES: dict[str, dict[str, str]] = {
    "plain": {},
    "joint range": {"joint": 'range="-.2 .1"'},
    "joint springs": {"joint": 'stiffness="5" springref=".4"', "second": 'stiffness="3"'},
    "joint armature, frictionloss": {"joint": 'armature=".1" frictionloss=".3"'},
    "joint margin": {"joint": 'range="-.2 .1" margin=".05"'},
    "joint actuatorfrcrange": {"joint": 'actuatorfrcrange="-.5 .5"'},
    "joint solref of limit": {"joint": 'range="-.2 .1" solreflimit="-500 -10"'},
    "joint actuatorgravcomp": {"joint": 'actuatorgravcomp="true"', "upper_body": 'gravcomp="1"'},
    "slide and ball joints": {
        "second": 'type="slide" axis="1 0 1"',
        "more": '<body pos="-1 0 1"><joint type="ball" damping=".1"/><geom type="box" size=".1 .05 .2" pos="0 0 .2"/></body>',
    },
    "ball joint range": {
        "more": '<body pos="-1 0 1"><joint type="ball" range="0 .3"/><geom type="box" size=".1 .05 .2" pos=".2 0 0"/></body>'
    },
    "gravcomp": {"upper_body": 'gravcomp=".7"'},
    "free fall and contact": {"height": ".1"},
    "box on floor": {"height": ".1", "ball": 'type="box" size=".1 .1 .1" mass="1"'},
    "capsule on floor": {"height": ".1", "ball": 'type="capsule" size=".1 .1" mass="1" euler="1.57 0 0"'},
    "cylinder on floor": {"height": ".1", "ball": 'type="cylinder" size=".1 .1" mass="1"'},
    "ellipsoid on floor": {"height": ".1", "ball": 'type="ellipsoid" size=".1 .2 .1" mass="1"'},
    "sphere on box": {"more": '<geom type="box" size=".3 .3 .1" pos="1 0 .1"/>'},
    "sphere on cylinder": {"more": '<geom type="cylinder" size=".3 .1" pos="1 0 .1"/>'},
    "sphere on capsule": {"more": '<geom type="capsule" size=".1 .2" pos="1 0 .1" euler="1.57 0 0"/>'},
    "sphere on ellipsoid": {"more": '<geom type="ellipsoid" size=".3 .3 .1" pos="1 0 .1"/>'},
    "height field": {
        "world": "",
        "rest": '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 .1 .1" elevation="0 0 0 0 1 0 0 0 0"/></asset>',
        "more": '<geom type="hfield" hfield="h" pos="1 0 .1"/>',
    },
    "mesh": {
        "rest": '<asset><mesh name="m" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset>',
        "ball": 'type="mesh" mesh="m" mass="1"',
        "height": ".05",
    },
    "condim 1": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" condim="1"', "floor": 'condim="1"'},
    "condim 4": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" condim="4"'},
    "condim 6": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" condim="6"'},
    "friction": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" friction=".3 .01 .001"'},
    "solref, solimp": {
        "height": ".1",
        "ball": 'type="sphere" size=".1" mass="1" solref=".01 .8" solimp=".8 .9 .01 .3 3"',
    },
    "solref direct": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" solref="-1000 -20"'},
    "margin, gap": {"height": ".12", "ball": 'type="sphere" size=".1" mass="1" margin=".05" gap=".02"'},
    "priority, solmix": {"height": ".1", "ball": 'type="sphere" size=".1" mass="1" priority="2" friction=".2"'},
    "contact pair": {
        "height": ".1",
        "ball": 'type="sphere" size=".1" mass="1" contype="0" conaffinity="0"',
        "rest": '<contact><pair geom1="floor" geom2="ball" condim="3" friction=".5 .5 .01 .001 .001"/></contact>',
    },
    "contact exclude": {"height": ".1", "rest": '<contact><exclude body1="world" body2="ball"/></contact>'},
    "fluidshape": {
        "option": 'density="1000" viscosity=".1"',
        "ball": 'type="sphere" size=".1" mass="1" fluidshape="ellipsoid"',
    },
    "density, viscosity, wind": {"option": 'density="100" viscosity=".01" wind="2 1 0"'},
    "gravity": {"option": 'gravity="1 2 -3"'},
    "magnetic": {"option": 'magnetic="1 0 0"'},
    "implicitfast": {"option": 'integrator="implicitfast"', "joint": 'armature=".01"'},
    "implicit": {"option": 'integrator="implicit"'},
    "RK4": {"option": 'integrator="RK4"'},
    "elliptic cone": {"option": 'cone="elliptic"', "height": ".1"},
    "impratio": {"option": 'impratio="5"', "height": ".1"},
    "elliptic, impratio": {"option": 'cone="elliptic" impratio="5"', "height": ".1"},
    "noslip": {"option": 'noslip_iterations="10"', "height": ".1"},
    "PGS": {"option": 'solver="PGS"', "height": ".1"},
    "CG": {"option": 'solver="CG"', "height": ".1"},
    "sparse": {"option": 'jacobian="sparse"', "height": ".1"},
    "o_margin": {"option": 'o_margin=".02" o_solref=".01 1"', "flag": '<flag override="enable"/>', "height": ".1"},
    **{
        f"flag {names} off": {
            "flag": f"<flag {' '.join(f'{name}={chr(34)}disable{chr(34)}' for name in names.split())}/>",
            "height": ".1",
            "joint": 'range="-.2 .1" stiffness="5"',
        }
        for names in [
            *("constraint", "contact equality", "limit frictionloss", "gravity", "clampctrl eulerdamp", "actuation"),
            *("warmstart refsafe", "sensor midphase nativeccd island", "filterparent"),
        ]
    },
    **{
        f"flag {name} on": {"flag": f'<flag {name}="enable"/>', "height": ".1"}
        for name in ["energy", "fwdinv", "invdiscrete", "multiccd", "sleep"]
    },
    "actuatorgroupdisable": {"option": 'actuatorgroupdisable="1"', "motor": 'group="1"'},
    "position": {"actuator": '<position joint="b" kp="20" kv="1" ctrlrange="-1 1"/>'},
    "position dampratio": {"actuator": '<position joint="b" kp="20" dampratio="1" ctrlrange="-1 1"/>'},
    "velocity": {"actuator": '<velocity joint="b" kv=".05" ctrlrange="-1 1"/>'},
    "damper": {"actuator": '<damper joint="b" kv="3" ctrlrange="0 1"/>'},
    "cylinder actuator": {"actuator": '<cylinder joint="b" timeconst=".2" area="2" ctrlrange="0 1"/>'},
    "general": {
        "actuator": '<general joint="b" gaintype="affine" gainprm="2 1 .5" biastype="affine" biasprm="1 -3 -.2" ctrlrange="-1 1"/>'
    },
    "adhesion": {"height": ".1", "actuator": '<adhesion body="ball" gain="20" ctrlrange="0 1"/>'},
    "forcerange": {"actuator": '<motor joint="b" forcerange="-.1 .2" gear="3" ctrlrange="-1 1"/>'},
    "jointinparent": {"actuator": '<motor jointinparent="b" ctrlrange="-1 1"/>'},
    "site actuator": {"actuator": '<motor site="s2" gear="1 0 0 0 0 1" ctrlrange="-1 1"/>'},
    "site actuator, refsite": {
        "actuator": '<position site="s2" refsite="s1" gear="1 0 0 0 0 0" kp="5" ctrlrange="-1 1"/>'
    },
    "slidercrank": {"actuator": '<motor cranksite="s2" slidersite="s1" cranklength=".5" ctrlrange="-1 1"/>'},
    "fixed tendon": _tendon(_FIXED.format('stiffness="3" damping=".2" springlength="0 .1"')),
    "fixed tendon range": _tendon(_FIXED.format('range="-.1 .1"')),
    "fixed tendon frictionloss": _tendon(_FIXED.format('frictionloss=".3"')),
    "fixed tendon armature": _tendon(_FIXED.format('armature=".3"')),
    "fixed tendon actuatorfrcrange": {
        **_tendon(_FIXED.format('actuatorfrcrange="-.1 .1"')),
        "actuator": '<motor tendon="t" ctrlrange="-1 1"/>',
    },
    "tendon motor": {**_tendon(_FIXED.format("")), "actuator": '<motor tendon="t" ctrlrange="-1 1"/>'},
    "spatial tendon": _tendon(_SPATIAL.format('stiffness="30" damping=".2"')),
    "spatial tendon range": _tendon(_SPATIAL.format('range=".1 .2"')),
    "spatial tendon armature": _tendon(_SPATIAL.format('armature=".1"')),
    "spatial tendon, pulley": _tendon(
        '<spatial name="t" stiffness="20"><site site="s1"/><site site="s2"/><pulley divisor="2"/>'
        '<site site="s2"/><site site="s3"/></spatial>'
    ),
    "wrapping tendon": _tendon(_WRAPPED),
    "equality connect": {"rest": '<equality><connect body1="fore" body2="ball" anchor=".3 0 0"/></equality>'},
    "equality weld": {"rest": '<equality><weld body1="fore" body2="ball"/></equality>'},
    "equality weld sites": {"rest": '<equality><weld site1="s2" site2="s3"/></equality>'},
    "equality joint": {"rest": '<equality><joint joint1="a" joint2="b" polycoef="0 .5 .1 0 0"/></equality>'},
    "equality tendon": _tendon(_FIXED.format(""), '<equality><tendon tendon1="t" polycoef=".1 0 0 0 0"/></equality>'),
    "equality inactive": {
        "rest": '<equality><connect body1="fore" body2="ball" anchor=".3 0 0" active="false"/></equality>'
    },
    "sensors": {"rest": '<sensor><touch site="s3"/><accelerometer site="s2"/><jointpos joint="a"/></sensor>'},
    "gravity compensation of a free body": {"height": ".5"},
}

#: Those of them that engine=mjx refuses.
REFUSED = frozenset(
    [
        "cylinder on floor",
        "ellipsoid on floor",
        "sphere on cylinder",
        "sphere on ellipsoid",
        "height field",
        "mesh",
        "fluidshape",
        "implicit",
        "noslip",
        "PGS",
        "o_margin",
        "flag filterparent off",
        "flag energy on",
        "flag fwdinv on",
        "actuatorgroupdisable",
        "adhesion",
        "slidercrank",
        "equality connect",
        "equality weld",
        "equality weld sites",
    ]
)


def model_text(feature: str) -> str:
    """MJCF of a feature."""
    text, own = MODEL, FEATURES[feature]
    if "axis" in own.get("second", ""):
        text = text.replace('axis="0 1 0" damping=".5" {second}', 'damping=".5" {second}')
    return text.format(**DEFAULTS | own)
