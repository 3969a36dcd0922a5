// The scene in 3D by three.js (WebGL): for orientation, not for measurement.

import * as THREE from "./three/three.module.min.js";

const MOST_LAMPS = 8; // that light the drawing; the strongest ones
const WITH_SHADOWS = 2;

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.autoUpdate = false;
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 2000);
    this.camera.matrixAutoUpdate = false;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0x000000);
    this.frames = [];
    this.asked = false;
    new ResizeObserver(() => this.#resize()).observe(canvas);
  }

  load(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const count = head.corners;
    const positions = new Float32Array(buffer, 4 + length, 3 * count);
    const normals = new Float32Array(buffer, 4 + length + 12 * count, 3 * count);
    const uv = head.uv && new Float32Array(buffer, 4 + length + 24 * count, 2 * count);
    this.head = head;
    this.bounds = new THREE.Box3();
    this.materials = head.materials.map((row) => this.#material(row));
    this.meshes = head.groups.map((group) => {
      const geometry = new THREE.BufferGeometry();
      const part = (array, width) => new THREE.BufferAttribute(
        array.subarray(group.first * width, (group.first + group.count) * width), width);
      geometry.setAttribute("position", part(positions, 3));
      geometry.setAttribute("normal", part(normals, 3));
      if (uv) geometry.setAttribute("uv", part(uv, 2));
      const mesh = new THREE.Mesh(geometry, this.materials[group.material]);
      const emits = head.objects[group.object].kind === "emitter";
      mesh.userData = group;
      mesh.castShadow = mesh.receiveShadow = !emits;
      if (!emits) {
        geometry.computeBoundingBox();
        this.bounds.union(geometry.boundingBox);
      }
      this.scene.add(mesh);
      return mesh;
    });
    this.#light(head);
    this.draw();
  }

  // Row-major pose of 16 numbers, full angle in degrees.
  look(pose, fov) {
    this.camera.matrix.copy(pose);
    this.camera.matrixWorldNeedsUpdate = true;
    this.camera.fov = fov;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  develop(ev, tone) {
    this.renderer.toneMapping = tone === "filmic" ? THREE.ACESFilmicToneMapping
      : THREE.LinearToneMapping;
    this.renderer.toneMappingExposure = 2 ** ev;
    this.draw();
  }

  edit(edits) {
    for (const mesh of this.meshes) {
      const change = edits.lamps[mesh.userData.object];
      mesh.position.set(...((change && change.move) || [0, 0, 0]));
    }
    this.lamps.forEach(({ light, lamp }) => {
      const { move = [0, 0, 0], gain = 1 } = edits.lamps[lamp.object] || {};
      light.position.set(...lamp.centre.map((value, axis) => value + move[axis]));
      light.intensity = light.userData.intensity * gain;
    });
    this.head.materials.forEach((row, at) => {
      this.#dress(this.materials[at], row, edits.materials[at] || {});
    });
    this.renderer.shadowMap.needsUpdate = true;
    this.draw();
  }

  // The group that a point of the canvas shows.
  at(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const point = new THREE.Vector2(2 * (x - box.left) / box.width - 1,
      1 - 2 * (y - box.top) / box.height);
    const ray = new THREE.Raycaster();
    this.scene.updateMatrixWorld();
    this.camera.updateMatrixWorld();
    ray.setFromCamera(point, this.camera);
    const hit = ray.intersectObjects(this.meshes, false)[0];
    return hit && hit.object.userData;
  }

  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      const began = performance.now();
      this.renderer.render(this.scene, this.camera);
      this.frames.push(performance.now() - began);
      if (this.frames.length > 500) this.frames.shift();
    });
  }

  #resize() {
    const size = Math.max(1, Math.round(this.canvas.clientWidth));
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    this.renderer.setSize(size, size, false);
    this.draw();
  }

  #material(row) {
    if (row.emission.some((value) => value > 0)) {
      const most = Math.max(...row.emission);
      const colour = new THREE.Color(...row.emission.map((value) => value / most));
      return new THREE.MeshBasicMaterial({ color: colour, side: THREE.DoubleSide,
        toneMapped: false, transparent: true, opacity: 0.55, depthWrite: false });
    }
    const made = new THREE.MeshPhysicalMaterial({ side: THREE.DoubleSide, metalness: 0 });
    made.ior = 0; // head-on reflectance is then specularColor times specularIntensity
    this.#dress(made, row, {});
    return made;
  }

  #dress(material, row, change) {
    if (!material.isMeshPhysicalMaterial) return;
    const worn = (name) => (name in row.maps && !(name in change) ? row.maps[name] : null);
    const specular = change.specular || row.specular;
    const most = Math.max(...specular, 1e-6);
    const maps = { map: worn("diffuse"), specularColorMap: worn("specular"),
      roughnessMap: worn("roughness") };
    for (const [slot, number] of Object.entries(maps)) {
      const before = material[slot];
      material[slot] = number === null ? null : this.#texture(number, slot !== "roughnessMap");
      if (before !== material[slot]) material.needsUpdate = true;
    }
    const white = [1, 1, 1];
    material.color.setRGB(...(maps.map === null ? change.diffuse || row.diffuse : white));
    material.specularIntensity = maps.specularColorMap === null ? most : 1;
    material.specularColor.setRGB(
      ...(maps.specularColorMap === null ? specular.map((value) => value / most) : white));
    material.roughness = maps.roughnessMap === null ? change.roughness ?? row.roughness : 1;
  }

  #texture(number, isColour) {
    this.textures ??= new Map();
    const key = `${number} ${isColour}`;
    if (!this.textures.has(key)) {
      const made = new THREE.TextureLoader().load(`api/texture/${number}`, () => this.draw());
      made.wrapS = made.wrapT = THREE.RepeatWrapping;
      made.colorSpace = isColour ? THREE.SRGBColorSpace : THREE.NoColorSpace;
      made.anisotropy = 4;
      this.textures.set(key, made);
    }
    return this.textures.get(key);
  }

  #light(head) {
    const power = (lamp) => lamp.area * Math.max(...lamp.radiance);
    const strongest = [...head.lamps].sort((a, b) => power(b) - power(a)).slice(0, MOST_LAMPS);
    this.lamps = strongest.map((lamp, place) => {
      const most = Math.max(...lamp.radiance);
      const light = new THREE.PointLight();
      light.color.setRGB(...lamp.radiance.map((value) => value / most));
      // head-on a flat lamp sends radiance times area, on average over directions half of it
      light.userData.intensity = light.intensity = 0.75 * power(lamp);
      light.position.set(...lamp.centre);
      if (place < WITH_SHADOWS) {
        light.castShadow = true;
        light.shadow.mapSize.set(512, 512);
        light.shadow.camera.near = 0.02;
        light.shadow.camera.far = 50;
        light.shadow.bias = -0.004;
        light.shadow.normalBias = 0.01;
      }
      this.scene.add(light);
      return { light, lamp };
    });
    // what bounces, guessed from what the lamps send to the middle of the scene
    const middle = this.bounds.isEmpty() ? new THREE.Vector3()
      : this.bounds.getCenter(new THREE.Vector3());
    const bounced = this.lamps.reduce((sum, { light }) =>
      sum + light.intensity / Math.max(0.2, light.position.distanceToSquared(middle)), 0);
    const up = new THREE.HemisphereLight(0xffffff, 0x555555, 0.12 * bounced);
    up.position.set(0, 0, 1);
    this.scene.add(up);
    this.renderer.shadowMap.needsUpdate = true;
  }

  // An environment as float RGBA, by directions of the scene's own world.
  sky(buffer) {
    const [width, height] = new Uint32Array(buffer, 0, 2);
    const halves = Uint16Array.from(new Float32Array(buffer, 8), (value) =>
      THREE.DataUtils.toHalfFloat(Math.min(value, 65504)));
    const map = new THREE.DataTexture(halves, width, height, THREE.RGBAFormat,
      THREE.HalfFloatType);
    map.magFilter = map.minFilter = THREE.LinearFilter;
    map.wrapS = THREE.RepeatWrapping;
    map.mapping = THREE.EquirectangularReflectionMapping;
    map.needsUpdate = true;
    const maker = new THREE.PMREMGenerator(this.renderer);
    this.scene.environment = maker.fromEquirectangular(map).texture;
    if (this.head.sky.seen) this.scene.background = map;
    this.draw();
  }
}
