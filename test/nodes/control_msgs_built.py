"""Builds what this package uses of control_msgs, which PyPI has not, with the generators that rclpy's wheels bring.

The interface is that of control_msgs 5 (Jazzy). C compiler and Python's headers are the machine's own.
"""

import subprocess
import sys
import sysconfig
from importlib import import_module
from pathlib import Path

import numpy

ACTION = """
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
int32 SUCCESSFUL = 0
int32 INVALID_GOAL = -1
int32 INVALID_JOINTS = -2
int32 OLD_HEADER_TIMESTAMP = -3
int32 PATH_TOLERANCE_VIOLATED = -4
int32 GOAL_TOLERANCE_VIOLATED = -5
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
"""
FILES = {
    "action/FollowJointTrajectory.action": ACTION,
    "msg/JointTolerance.msg": "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n",
    "msg/JointComponentTolerance.msg": "string joint_name\nuint16 component\nfloat64 position\nfloat64 velocity\n"
    "float64 acceleration\n",
}
PACKAGE = "control_msgs"
USED = "trajectory_msgs action_msgs unique_identifier_msgs builtin_interfaces service_msgs std_msgs geometry_msgs"
SUPPORTS = "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"


def build(folder):
    """Build the package in ``folder``/control_msgs; ``folder`` is then to be on the path of Python."""

    def of(package, name, **options):
        return getattr(import_module(f"rosidl_{package}.cli"), name)("", **options)

    prefix, made, interfaces = Path(sys.prefix), folder / PACKAGE, []
    for name, text in FILES.items():
        source = folder / "source" / name
        source.parent.mkdir(parents=True, exist_ok=True)
        source.write_text(text)
        translate = of("adapter", f"Translate{name.partition('.')[2].capitalize()}ToIDL")
        interfaces += translate.translate(PACKAGE, [f"{folder / 'source'}:{name}"], [], output_path=folder / "idl")
    for generator, into in (
        (of("generator_c", "GenerateC"), made),
        (of("generator_py", "GeneratePython", typesupport_implementations=["rosidl_typesupport_c"]), made),
        (of("typesupport_c", "GenerateCTypesupport", typesupport_implementations=list(SUPPORTS)), made),
        (of("typesupport_fastrtps_c", "GenerateFastRTPSCTypesupport"), made),
        (of("typesupport_introspection_c", "GenerateIntrospectionCTypesupport"), folder / "introspection" / PACKAGE),
    ):
        generator.generate(
            PACKAGE, interfaces, [str(prefix / "share" / name) for name in USED.split()], output_path=into
        )
    (made / "__init__.py").touch()

    headers = [folder, folder / "introspection", sysconfig.get_paths()["include"], numpy.get_include()]
    headers += [prefix / "include", *(prefix / "include").iterdir()]
    libraries = [path for name in USED.split() for path in (prefix / "lib").glob(f"lib{name}__rosidl_*.so")]
    libraries += [*(prefix / "lib").glob("librosidl_*.so"), prefix / "lib" / "libfastcdr.so"]

    def link(name, sources, *more):
        sources, objects = sorted(path for path in sources if path.suffix in (".c", ".cpp")), []
        for source in sources:
            objects.append(source.with_suffix(f"{source.suffix}.o"))
            compiler = ["gcc"] if source.suffix == ".c" else ["g++", "-std=c++17"]
            options = ["-w", "-O0", "-fPIC", *(f"-I{path}" for path in headers)]
            subprocess.run([*compiler, *options, "-c", source, "-o", objects[-1]], check=True)
        options = ["-shared", f"-Wl,-soname,{name}", "-Wl,-rpath,$ORIGIN", "-Wl,--no-as-needed"]
        subprocess.run(["g++", *options, *objects, *more, *libraries, "-o", made / name], check=True)
        return made / name

    # The dispatching type support looks for the others by the names of their libraries.
    ours = [f"lib{PACKAGE}__{name}.so" for name in SUPPORTS]
    built = [link(ours[0], made.rglob("*"))]
    built.append(link(ours[1], (folder / "introspection").rglob("*"), *built))
    link(f"{PACKAGE}_s__rosidl_typesupport_c.so", made.glob("_*.c"), *built)
